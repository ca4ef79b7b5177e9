"""Compose the README's picture from a run directory.

visctrl run --start -0.9 -2.6 30 --out runs/picture && python docs/picture.py runs/picture
"""

import sys
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt

VIEWS = {"initial": "initial view", "final": "final view", "target": "target view"}


def main(run: Path, out: Path) -> None:
    """Draw the path and the three views of ``run`` side by side into ``out``."""
    ticks = np.genfromtxt(
        run / "ticks.csv",
        delimiter=",",
        names=True,
        deletechars="",
        usecols=("x_true_[m]", "y_true_[m]", "phi_true_[rad]"),
    )
    x, y, phi = (ticks[name] for name in ticks.dtype.names)
    figure, axes = plt.subplots(1, 4, figsize=(13, 3.6), width_ratios=(1.0, 1.2, 1.2, 1.2))
    path = axes[0]
    path.plot(x, y, color="#1f77b4")
    some = slice(0, None, 12)
    path.quiver(x[some], y[some], -np.sin(phi[some]), np.cos(phi[some]), width=0.012, scale=9)
    path.plot(0, 0, "r+", markersize=14, markeredgewidth=2)
    path.set(xlabel="x [m]", ylabel="y [m]", title="path and heading")
    path.set_aspect("equal", adjustable="datalim")
    path.grid(alpha=0.3)
    for axis, (name, title) in zip(axes[1:], VIEWS.items(), strict=True):
        axis.imshow(plt.imread(run / f"{name}.png")[..., :3])
        axis.set_title(title)
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(out, dpi=90)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(__file__).with_name("run.png"))
