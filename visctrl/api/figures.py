"""Figures of a run for notebooks: Matplotlib, no window."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from visctrl.api.results import Run


def run_figure(run: Run) -> Figure:
    """Return the path from above beside velocities and features over time."""
    log = run.columns
    x, y, phi = log.pose()
    figure = Figure(figsize=(10.0, 4.5), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.0, 1.3))
    above = figure.add_subplot(grid[:, 0])
    above.plot(x, y, color="tab:blue")
    every = max(1, len(x) // 12)
    above.quiver(x[::every], y[::every], -np.sin(phi[::every]), np.cos(phi[::every]), width=4e-3)
    above.plot(0.0, 0.0, "k+", markersize=12, label="target")
    source = "true path" if log.pose_source == "true" else "odometry"
    above.set(xlabel="x (m)", ylabel="y (m)", title=source, aspect="equal")
    above.legend()
    rows = (("v_sent", "v (m/s)"), ("omega_sent", "ω (rad/s)"), ("features", "features"))
    for number, (name, label) in enumerate(rows):
        axes = figure.add_subplot(grid[number, 1])
        axes.plot(log.t, log.numbers[name], color="tab:blue")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    axes.set_xlabel("t (s)")
    figure.suptitle(f"{run.status}: {run.reason}", fontsize=10)
    return figure
