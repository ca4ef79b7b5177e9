"""One page of plots of a run, drawn from its ``ticks.csv``."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from robots.errors import InputError
from visctrl.plugins import Array
from visctrl.runtime.recorder import TICKS, WORDS
from visctrl.runtime.records import STAGES

#: Most lines in one panel of plugin signals.
_MOST_LINES = 8
_ROW_INCHES = 4.2
#: Whole numbers beyond this are counts and get a panel of their own.
_FEW = 5.0


@dataclass(frozen=True)
class Ticks:
    """The columns of a ``ticks.csv`` by name without unit; empty cells are NaN.

    numbers : numeric columns; words : the others; units : of the numeric ones.
    """

    numbers: dict[str, Array]
    words: dict[str, list[str]]
    units: dict[str, str]

    def __len__(self) -> int:
        return len(self.words["stage"])

    def degrees(self, name: str) -> Array:
        """Return an angle column in degrees."""
        return np.degrees(self.numbers[name])


def read_ticks(path: Path) -> Ticks:
    """Read a ``ticks.csv``; a last line cut short by a crash is left out.

    Raises
    ------
    InputError
        There is no such file, or it is not one of ours.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            header, *rows = list(csv.reader(file)) or [[]]
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    whole = [row for row in rows if len(row) == len(header)]
    columns = list(zip(*whole, strict=True)) or [() for _ in header]
    numbers: dict[str, Array] = {}
    words: dict[str, list[str]] = {}
    units: dict[str, str] = {}
    for title, cells in zip(header, columns, strict=True):
        name, _, unit = title.partition(" [")
        if name in WORDS:
            words[name] = list(cells)
        else:
            numbers[name] = _as_numbers(cells, path)
            units[name] = unit.rstrip("]")
    if "t" not in numbers or "stage" not in words:
        raise InputError(f"{path}: is not a tick log")
    return Ticks(numbers, words, units)


def _as_numbers(cells: Sequence[str], path: Path) -> Array:
    try:
        return np.array([float(cell or "nan") for cell in cells])
    except ValueError as error:
        raise InputError(f"{path}: is not a tick log: {error}") from None


def plot_run(directory: Path, target: Path) -> None:
    """Draw the page of the run in ``directory`` into the PNG file ``target``.

    Path, pose, inputs, features, the plugins' signals and tick times, on one page.

    Raises
    ------
    InputError
        The run has no readable ``ticks.csv``.
    """
    ticks = read_ticks(directory / TICKS)
    groups = _signal_groups(ticks)
    rows = 2 + (len(groups) + 2) // 3
    height = _ROW_INCHES * rows
    figure = Figure(figsize=(15.0, height))
    FigureCanvasAgg(figure)
    # Fixed margins: a layout engine would draw the page twice.
    figure.subplots_adjust(
        left=0.05, right=0.95, wspace=0.38, bottom=0.6 / height, top=1 - 0.5 / height, hspace=0.3
    )
    axes = figure.subplots(rows, 3, squeeze=False).ravel()
    panels = (_path, _states, _inputs, _features, _tick_times, _lateness)
    for panel, axis in zip(panels, axes, strict=False):
        panel(axis, ticks)
    for (unit, names), axis in zip(groups, axes[len(panels) :], strict=False):
        _signals(axis, ticks, unit, names)
    for axis in axes[len(panels) + len(groups) :]:
        axis.set_axis_off()
    figure.savefig(target, dpi=100)


def _pose(ticks: Ticks) -> str:
    """Return the suffix of the pose columns to show: true where known, else odometry."""
    known = np.isfinite(ticks.numbers["x_true"]).any()
    return "true" if known else "odometry"


def _path(axis: Axes, ticks: Ticks) -> None:
    which = _pose(ticks)
    x, y = ticks.numbers[f"x_{which}"], ticks.numbers[f"y_{which}"]
    phi = ticks.numbers[f"phi_{which}"]
    axis.plot(x, y, color="C0")
    step = max(1, len(ticks) // 25)
    axis.quiver(
        x[::step],
        y[::step],
        -np.sin(phi[::step]),
        np.cos(phi[::step]),
        angles="xy",
        scale=18,
        width=0.005,
        color="C0",
        alpha=0.6,
    )
    axis.plot(x[:1], y[:1], "o", color="C2", label="start")
    if which == "true":
        axis.plot(0.0, 0.0, "+", color="C3", markersize=14, markeredgewidth=2, label="target")
    axis.set(title=f"path ({which})", xlabel="x [m]", ylabel="y [m]")
    axis.set_aspect("equal", adjustable="datalim")
    axis.legend(loc="best")


def _states(axis: Axes, ticks: Ticks) -> None:
    which = _pose(ticks)
    t = ticks.numbers["t"]
    axis.plot(t, ticks.numbers[f"x_{which}"], label="x [m]")
    axis.plot(t, ticks.numbers[f"y_{which}"], label="y [m]")
    axis.plot([], [], color="C2", label="φ [deg]")
    twin = _second_scale(axis, "φ [deg]")
    twin.plot(t, ticks.degrees(f"phi_{which}"), color="C2")
    _finish(axis, f"pose of the camera ({which})", "m")


def _inputs(axis: Axes, ticks: Ticks) -> None:
    t = ticks.numbers["t"]
    axis.plot(t, ticks.numbers["v_wanted"], color="C0", alpha=0.35, label="v wanted")
    axis.step(t, ticks.numbers["v_sent"], color="C0", where="post", label="v sent [m/s]")
    axis.plot([], [], color="C1", label="ω sent [deg/s]")
    twin = _second_scale(axis, "deg/s")
    twin.plot(t, ticks.degrees("omega_wanted"), color="C1", alpha=0.35)
    twin.step(t, ticks.degrees("omega_sent"), color="C1", where="post")
    _finish(axis, "inputs", "m/s")


def _features(axis: Axes, ticks: Ticks) -> None:
    t = ticks.numbers["t"]
    axis.plot(t, ticks.numbers["features"], label="features")
    axis.set_ylim(bottom=0.0)
    _finish(axis, "features in all three views", "number")


def _tick_times(axis: Axes, ticks: Ticks) -> None:
    axis.stackplot(
        ticks.numbers["t"],
        [np.nan_to_num(ticks.numbers[name]) for name in STAGES[:-1]],
        labels=STAGES[:-1],
    )
    _finish(axis, "time of a tick", "ms")


def _lateness(axis: Axes, ticks: Ticks) -> None:
    t, missed = ticks.numbers["t"], ticks.numbers["missed"]
    axis.plot(t, ticks.numbers["lateness"], label="lateness")
    late = missed > 0
    axis.plot(t[late], ticks.numbers["lateness"][late], "x", color="C3", label="after missed ticks")
    _finish(axis, f"lateness, {int(missed.sum())} ticks missed", "ms")


def _signals(axis: Axes, ticks: Ticks, unit: str, names: Sequence[str]) -> None:
    t = ticks.numbers["t"]
    for name in names:
        axis.plot(t, ticks.numbers[name], label=name.partition(".")[2], linewidth=1.0)
    plugin = names[0].partition(".")[0]
    _finish(axis, plugin, unit)


def _signal_groups(ticks: Ticks) -> list[tuple[str, list[str]]]:
    """Return the plugins' signals that hold anything, those that share a scale together."""
    groups: dict[tuple[str, str, bool], list[str]] = {}
    for name, values in ticks.numbers.items():
        plugin, dot, _ = name.partition(".")
        finite = values[np.isfinite(values)]
        if dot and finite.size > 1:
            is_count = bool(finite.max() > _FEW and (finite == np.round(finite)).all())
            groups.setdefault((plugin, ticks.units[name], is_count), []).append(name)
    return [
        (unit, names[first : first + _MOST_LINES])
        for (_, unit, _), names in groups.items()
        for first in range(0, len(names), _MOST_LINES)
    ]


def _second_scale(axis: Axes, label: str) -> Axes:
    """Return axes with a scale of their own, behind ``axis`` and its legend."""
    twin = axis.twinx()
    twin.set_ylabel(label)
    axis.set_zorder(twin.get_zorder() + 1)
    axis.patch.set_visible(False)
    return twin


def _finish(axis: Axes, title: str, unit: str) -> None:
    axis.set(title=title, xlabel="t [s]", ylabel=unit)
    axis.grid(visible=True, alpha=0.3)
    axis.legend(loc="best", fontsize="small")
