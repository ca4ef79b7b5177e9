"""Paths, states, epipoles and inputs of several runs on one page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from visctrl.report.ticks import Ticks, read_ticks

#: Panels over time: title, column of ``ticks.csv``, factor.
_PANELS = (
    ("e23", "epipoles.e23", 1.0),
    ("e32", "epipoles.e32", 1.0),
    ("e12", "epipoles.e12", 1.0),
    ("φ (deg)", "phi_true", 180.0 / np.pi),
    ("v (m/s)", "v_sent", 1.0),
    ("ω (rad/s)", "omega_sent", 1.0),
)
#: Epipoles beyond this are off the page.
_MOST = 2.0


def plot_runs(out: Path, directories: Sequence[Path | None], title: str) -> Path:
    """Draw the recorded runs and return the picture's path, ``out/runs.png``."""
    figure = Figure(figsize=(13, 9), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    axes = figure.subplots(2, 4).ravel()
    for directory in directories:
        if directory is not None:
            _draw(axes, read_ticks(directory / "ticks.csv"), directory.name)
    axes[0].set(title="path", xlabel="x (m)", ylabel="y (m)", aspect="equal")
    for axis, (name, _, _) in zip(axes[1:], _PANELS, strict=False):
        axis.set(title=name, xlabel="time (s)")
        axis.grid(alpha=0.3)
    axes[-1].axis("off")
    handles, labels = axes[0].get_legend_handles_labels()
    axes[-1].legend(handles, labels, loc="center", fontsize=6)
    path = out / "runs.png"
    figure.savefig(path, dpi=110)
    return path


def _draw(axes: np.ndarray[tuple[int], np.dtype[np.object_]], ticks: Ticks, label: str) -> None:
    numbers = ticks.numbers
    axes[0].plot(numbers["x_true"], numbers["y_true"], label=label)
    for axis, (_, column, factor) in zip(axes[1:], _PANELS, strict=False):
        if column in numbers:
            values = factor * numbers[column]
            shown = np.abs(values) < _MOST if column.startswith("epipoles") else np.isfinite(values)
            axis.plot(numbers["t"], np.where(shown, values, np.nan))
