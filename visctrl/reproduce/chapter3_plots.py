"""Paths, states, tensor elements, inputs and image motion of trifocal runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from visctrl.geometry.trifocal.tensor import ELEMENTS
from visctrl.reproduce.figures import page, saved
from visctrl.reproduce.image_motion import draw_motion
from visctrl.viewers.report.ticks import Ticks, read_ticks

#: Panels over time: title, column of ``ticks.csv``, factor.
_PANELS = (
    ("x (m)", "x_true", 1.0),
    ("y (m)", "y_true", 1.0),
    ("φ (deg)", "phi_true", 180.0 / np.pi),
    ("ξ1", "tensor.xi1", 1.0),
    ("ξ2", "tensor.xi2", 1.0),
    ("v (m/s)", "v_sent", 1.0),
    ("ω (rad/s)", "omega_sent", 1.0),
)
#: References are drawn dashed over what they belong to.
_REFERENCES = {"tensor.xi1": "reference_xi1", "tensor.xi2": "reference_xi2"}


def plot_states(out: Path, directories: Sequence[Path], title: str) -> Path:
    """Draw paths, states, outputs and inputs of recorded runs; return ``out/runs.png``."""
    figure = page(title, 13.0, 10.0)
    axes = figure.subplots(3, 3).ravel()
    for number, directory in enumerate(directories):
        _draw_states(axes, read_ticks(directory / "ticks.csv"), directory.name, f"C{number}")
    axes[0].plot(0.0, 0.0, "+", color="k", markersize=12)
    axes[0].set(title="path", xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes[0].grid(alpha=0.3)
    for axis, (name, _, _) in zip(axes[1:], _PANELS, strict=False):
        axis.set(title=name, xlabel="time (s)")
        axis.grid(alpha=0.3)
    axes[-1].axis("off")
    handles, labels = axes[0].get_legend_handles_labels()
    axes[-1].legend(handles, labels, loc="center", fontsize="small")
    return saved(figure, out / "runs.png")


def plot_tensors(out: Path, directories: Sequence[Path], title: str) -> Path:
    """Draw the normalised tensor elements of recorded runs; return ``out/tensor.png``."""
    figure = page(title, 5.5 * len(directories), 8.0)
    rows = figure.subplots(2, len(directories), squeeze=False, sharex="col")
    for (above, below), directory in zip(rows.T, directories, strict=True):
        ticks = read_ticks(directory / "ticks.csv")
        for name in ELEMENTS:
            axis = above if name.startswith("T1") else below
            axis.plot(ticks.numbers["t"], ticks.numbers[f"tensor.{name}"], label=name)
        above.set(title=directory.name)
        below.set(xlabel="time (s)")
        for axis in (above, below):
            axis.grid(alpha=0.3)
            axis.legend(fontsize="small")
    return saved(figure, out / "tensor.png")


def plot_motion(out: Path, directories: Sequence[Path], title: str) -> Path:
    """Draw how the features move in the image; return ``out/image_motion.png``."""
    figure = page(title, 6.5 * len(directories), 5.5)
    axes = figure.subplots(1, len(directories), squeeze=False)[0]
    for axis, directory in zip(axes, directories, strict=True):
        draw_motion(axis, directory, directory.name)
    return saved(figure, out / "image_motion.png")


def _draw_states(
    axes: np.ndarray[tuple[int], np.dtype[np.object_]], ticks: Ticks, label: str, colour: str
) -> None:
    numbers, t = ticks.numbers, ticks.numbers["t"]
    axes[0].plot(numbers["x_true"], numbers["y_true"], label=label, color=colour)
    for axis, (_, column, factor) in zip(axes[1:], _PANELS, strict=False):
        if column not in numbers:
            continue
        axis.plot(t, factor * numbers[column], color=colour)
        reference = _REFERENCES.get(column, "")
        for name in numbers:
            if reference and name.endswith(f".{reference}"):
                axis.plot(t, numbers[name], "k--", linewidth=0.8)
