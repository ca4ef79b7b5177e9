"""Pictures of the pose scheme: consistency over many runs, single runs side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle
from numpy.typing import NDArray

from visctrl.reproduce.chapter4_runs import COLUMNS, Averages
from visctrl.reproduce.figures import page, saved
from visctrl.viewers.report.ticks import Ticks, read_ticks

Array = NDArray[np.float64]

#: Panels over time: title, column of ``ticks.csv``, factor.
_PANELS = (
    ("φ (deg)", "phi_true", 180.0 / np.pi),
    ("v (m/s)", "v_sent", 1.0),
    ("ω (deg/s)", "omega_sent", 180.0 / np.pi),
)
_ERRORS = (("x", "cm", 100.0), ("y", "cm", 100.0), ("phi", "deg", 180.0 / np.pi))
#: Most runs whose errors are drawn one by one.
_SHOWN = 20


def plot_consistency(out: Path, groups: Mapping[str, Averages]) -> Path:
    """Draw averaged NEES and NIS with their bounds, one row a start; return the picture's path."""
    figure = page("NEES and NIS per degree of freedom, averaged over runs", 12.0, 3.0 * len(groups))
    rows = figure.subplots(len(groups), 2, squeeze=False)
    for (left, right), (name, group) in zip(rows, groups.items(), strict=True):
        _draw_average(left, group.nees, group.nees_bounds)
        _draw_average(right, group.nis, group.nis_bounds)
        left.set(title=f"{name}: NEES, {100 * group.nees_inside:.0f} % inside")
        right.set(title=f"{name}: NIS, {100 * group.nis_inside:.0f} % inside")
    return saved(figure, out / "consistency.png")


def plot_errors(out: Path, traces: Sequence[Array], title: str) -> Path:
    """Draw estimation errors of runs with the filter's own 2σ; return the picture's path."""
    figure = page(title, 12.0, 9.0)
    axes = figure.subplots(3, 1, sharex=True)
    steps = min(len(trace) for trace in traces)
    stack = np.stack([trace[:steps] for trace in traces])
    time = stack[0, :, 0] - stack[0, 0, 0]
    for axis, (name, unit, factor) in zip(axes, _ERRORS, strict=True):
        error = factor * stack[..., COLUMNS.index(f"{name}_error")]
        deviation = factor * stack[..., COLUMNS.index(f"{name}_sd")].mean(axis=0)
        axis.plot(time, error[:_SHOWN].T, color="0.6", linewidth=0.6)
        axis.plot(time, 2.0 * error.std(axis=0), "C0", label="2 st. dev. over the runs")
        axis.plot(time, 2.0 * deviation, "C3--", label="2σ of the filter, mean")
        axis.plot(time, -2.0 * deviation, "C3--")
        axis.set(ylabel=f"{name} ({unit})", ylim=np.array([-4.0, 4.0]) * np.median(deviation))
        axis.grid(alpha=0.3)
    axes[0].legend(loc="upper right")
    axes[-1].set(xlabel="time since the first pose (s)")
    return saved(figure, out / "errors.png")


def plot_runs(
    out: Path,
    directories: Sequence[Path],
    title: str,
    obstacles: Sequence[tuple[float, float, float, int | None]] = (),
) -> Path:
    """Draw recorded runs and obstacles; return the picture's path.

    obstacles : x, y and radius (m), and which run they stood in, None for all.
    """
    figure = page(title, 13.0, 8.0)
    axes = figure.subplots(2, 3).ravel()
    for number, directory in enumerate(directories):
        label = " ".join(directory.name.replace("_", " ").split())
        _draw_run(axes, read_ticks(directory / "ticks.csv"), label, f"C{number}")
    for x, y, radius, run in obstacles:
        color = "0.4" if run is None else f"C{run}"
        axes[0].add_patch(Circle((x, y), radius, facecolor=color, edgecolor=color, alpha=0.4))
    axes[0].plot(0.0, 0.0, "k+", markersize=12)
    axes[0].set(title="path (dotted: estimated)", xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes[0].grid(alpha=0.3)
    for axis, (name, _, _) in zip(axes[1:], _PANELS, strict=False):
        axis.set(title=name, xlabel="time (s)")
        axis.grid(alpha=0.3)
    axes[4].set(title="error of the estimated position (cm)", xlabel="time (s)", yscale="log")
    axes[4].grid(alpha=0.3)
    axes[5].axis("off")
    axes[5].legend(*axes[0].get_legend_handles_labels(), loc="center", fontsize="small")
    return saved(figure, out / "runs.png")


def plot_curves(out: Path, curves: Mapping[str, tuple[Array, Array, Array]], bounds: Array) -> Path:
    """Draw mean ± deviation of final errors over what is wrong with the camera.

    curves : by axis label, where (K,), means (K, 3) and deviations (K, 3) in cm, cm, deg.
    bounds : (3,) published ones.
    """
    figure = page("final errors with a wrong camera", 12.0, 9.0)
    rows = figure.subplots(3, len(curves), squeeze=False)
    for column, (label, (where, mean, deviation)) in zip(rows.T, curves.items(), strict=True):
        for axis, (name, unit, _), m, s, bound in zip(
            column, _ERRORS, mean.T, deviation.T, bounds, strict=True
        ):
            axis.errorbar(where, m, yerr=s, fmt="o-", capsize=4)
            axis.axhline(bound, color="C3", linestyle="--")
            axis.axhline(-bound, color="C3", linestyle="--")
            axis.set(ylabel=f"{name} ({unit})")
            axis.grid(alpha=0.3)
        column[-1].set(xlabel=label)
    return saved(figure, out / "curves.png")


def _draw_average(axis: Axes, values: Array, bounds: Array) -> None:
    axis.plot(values, linewidth=0.8)
    axis.plot(bounds[:, 0], "C3--", linewidth=0.8)
    axis.plot(bounds[:, 1], "C3--", linewidth=0.8)
    axis.set(ylim=(0.0, max(2.0, float(np.percentile(values, 99)))), xlabel="step")
    axis.grid(alpha=0.3)


def _draw_run(axes: NDArray[np.object_], ticks: Ticks, label: str, color: str) -> None:
    numbers = ticks.numbers
    x, y, t = numbers["x_true"], numbers["y_true"], numbers["t"]
    axes[0].plot(x, y, color=color, label=label)
    for axis, (_, column, factor) in zip(axes[1:], _PANELS, strict=False):
        axis.plot(t, factor * np.asarray(numbers[column]), color=color)
    for estimator in ("transfer", "ekf"):
        if f"{estimator}.x" in numbers:
            x_found, y_found = numbers[f"{estimator}.x"], numbers[f"{estimator}.y"]
            axes[0].plot(x_found, y_found, ":", color=color)
            error = 100.0 * np.hypot(np.subtract(x_found, x), np.subtract(y_found, y))
            axes[4].plot(t, np.maximum(error, 1e-2), color=color)
