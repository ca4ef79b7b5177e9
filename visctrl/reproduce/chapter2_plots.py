"""Paths, states, epipoles, inputs and image motion of epipolar runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from visctrl.reproduce.figures import page, saved
from visctrl.reproduce.image_motion import draw_motion
from visctrl.viewers.report.ticks import Ticks, read_ticks

#: Panels over time: title, column of ``ticks.csv``, factor.
_PANELS = (
    ("x (m)", "x_true", 1.0),
    ("y (m)", "y_true", 1.0),
    ("φ (deg)", "phi_true", 180.0 / np.pi),
    ("v (m/s)", "v_sent", 1.0),
    ("ω (rad/s)", "omega_sent", 1.0),
    ("e23, for a unit focal length", "epipoles.e23", 1.0),
    ("e32", "epipoles.e32", 1.0),
    ("e12", "epipoles.e12", 1.0),
    ("e22ar, of the aligned robot's view", "epipoles.e22ar", 1.0),
)
#: Epipoles beyond this are off the page.
_MOST = 2.0
#: Inputs beyond this share a page with others only on a logarithmic scale.
_EXPLODED = 20.0
#: Panels of image motion side by side.
_COLUMNS = 4

Sweep = Mapping[float, Mapping[str, float]]


def plot_runs(out: Path, runs: Mapping[str, Path | None], title: str) -> Path:
    """Draw recorded runs, by what the legend calls them, and return ``out/runs.png``."""
    figure = page(title, 16.0, 10.0)
    axes = figure.subplots(3, 4).ravel()
    for label, directory in runs.items():
        if directory is not None:
            _draw(axes, read_ticks(directory / "ticks.csv"), label)
    for axis in axes[4:6]:
        if max(abs(limit) for limit in axis.get_ylim()) > _EXPLODED:
            axis.set_yscale("symlog", linthresh=1.0)
    axes[0].plot(0.0, 0.0, "k+", markersize=12)
    axes[0].set(title="path", xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes[0].grid(alpha=0.3)
    for axis, (name, _, _) in zip(axes[1:], _PANELS, strict=False):
        axis.set(title=name, xlabel="time (s)")
        axis.grid(alpha=0.3)
    handles, labels = axes[0].get_legend_handles_labels()
    axes[-1].legend(handles, labels, loc="center", fontsize="medium")
    for axis in axes[1 + len(_PANELS) :]:
        axis.axis("off")
    return saved(figure, out / "runs.png")


def plot_motion(out: Path, runs: Mapping[str, Path | None], title: str) -> Path:
    """Draw how the features move in the image; return ``out/image_motion.png``.

    Dot: where a feature starts; cross: where it ends; circle: where the target shows it.
    """
    columns = min(len(runs), _COLUMNS)
    rows = -(-len(runs) // columns)
    figure = page(title, 5.5 * columns, 4.7 * rows)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis, (label, directory) in zip(axes, runs.items(), strict=False):
        if directory is not None:
            draw_motion(axis, directory, label)
    for axis in axes[len(runs) :]:
        axis.axis("off")
    return saved(figure, out / "image_motion.png")


def plot_sweeps(out: Path, sweeps: Mapping[str, Mapping[str, Sweep]], title: str) -> Path:
    """Draw final errors over a parameter; return ``out/sweep.png``.

    Parameters
    ----------
    sweeps : mapping
        Parameter → law → value of the parameter → quantity → final error.
    """
    quantities = list(next(iter(next(iter(next(iter(sweeps.values())).values())).values())))
    figure = page(title, 5.0 * len(quantities), 4.0 * len(sweeps))
    rows = figure.subplots(len(sweeps), len(quantities), squeeze=False)
    for row, (parameter, laws) in zip(rows, sweeps.items(), strict=True):
        for axis, quantity in zip(row, quantities, strict=True):
            for law, sweep in laws.items():
                axis.plot(list(sweep), [errors[quantity] for errors in sweep.values()], label=law)
            axis.set(xlabel=parameter, ylabel=quantity)
            axis.grid(alpha=0.3)
            axis.legend(fontsize="small")
    return saved(figure, out / "sweep.png")


def plot_scatter(out: Path, ends: Mapping[str, Sequence[Mapping[str, float]]], title: str) -> Path:
    """Draw where the seeds of each case ended, in cm about the target; return ``out/ends.png``."""
    figure = page(title, 4.2 * len(ends), 4.2)
    axes = figure.subplots(1, len(ends), squeeze=False)[0]
    for axis, (case, errors) in zip(axes, ends.items(), strict=True):
        axis.plot([e["x_cm"] for e in errors], [e["y_cm"] for e in errors], ".")
        axis.plot(0.0, 0.0, "k+", markersize=12)
        axis.set(title=case, xlabel="x (cm)", ylabel="y (cm)")
        axis.axis("equal")
        axis.grid(alpha=0.3)
    return saved(figure, out / "ends.png")


def _draw(axes: np.ndarray[tuple[int], np.dtype[np.object_]], ticks: Ticks, label: str) -> None:
    numbers = ticks.numbers
    axes[0].plot(numbers["x_true"], numbers["y_true"], label=label)
    for axis, (_, column, factor) in zip(axes[1:], _PANELS, strict=False):
        values = factor * numbers[column]
        shown = np.abs(values) < _MOST if column.startswith("epipoles") else np.isfinite(values)
        axis.plot(numbers["t"], np.where(shown, values, np.nan), linewidth=1.0)
