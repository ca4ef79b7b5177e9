"""Which charts a run's signals become."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from visctrl.contracts import Array
from visctrl.runtime.records import STAGES
from visctrl.viewers.report.svg import Chart, Line
from visctrl.viewers.report.ticks import Ticks

#: Signals that are shown together, by their names without the plugin's.
_GROUPS = (
    ("epipoles of the current and the target view", ("e23", "e32", "e23_ref", "e32_ref")),
    ("epipoles of the initial and the current view", ("e12", "e21")),
    ("epipoles of the initial and the target view", ("e13", "e31")),
    ("tensor elements, first half", ("T111", "T112", "T121", "T122")),
    ("tensor elements, second half", ("T211", "T212", "T221", "T222")),
    ("outputs of the tensor", ("xi1", "xi2", "reference_xi1", "reference_xi2")),
)
_POSE = ("x", "y", "phi")
_SD = "_sd"
_REFERENCES = ("reference_", "_reference", "_ref")
_SYMBOLS = {"xi1": "ξ1", "xi2": "ξ2", "phi": "φ", "omega": "ω", "psi": "ψ", "sigma": "σ"}
#: Most lines in one chart of other signals.
_MOST_LINES = 6
#: Whole numbers beyond this are counts and get a chart of their own.
_FEW = 5.0


@dataclass(frozen=True)
class Span:
    """A part of a run: stage and phase, from ``begin`` to ``end`` (s)."""

    name: str
    begin: float
    end: float


def phases(ticks: Ticks) -> list[Span]:
    """Return the stages and phases of a run in order."""
    t = ticks.t.tolist()
    names = [
        phase if stage == "main" and phase else f"{stage} {phase}".strip()
        for stage, phase in zip(ticks.words["stage"], ticks.words["phase"], strict=True)
    ]
    spans = []
    for name, group in groupby(range(len(t)), key=names.__getitem__):
        places = list(group)
        after = t[min(places[-1] + 1, len(t) - 1)]
        spans.append(Span(name, t[places[0]], after))
    return spans


def events(ticks: Ticks) -> list[tuple[float, str]]:
    """Return what safety did: the times (s) at which something new began, and what it was."""
    found = []
    before = ""
    for t, event in zip(ticks.t.tolist(), ticks.words["event"], strict=True):
        # "frame is 0.72 s old" goes on being the same event.
        kind = "".join(c for c in event if not c.isdigit())
        if event and kind != before:
            found.append((t, event))
        before = kind
    return found


def main_charts(ticks: Ticks) -> list[Chart]:
    """Return the charts that every run has, and those of its estimator."""
    shown = [*_pose_charts(ticks), *_input_charts(ticks)]
    for title, names in _GROUPS:
        if chart := _group(ticks, title, names):
            shown.append(chart)
    return [*shown, *_error_charts(ticks), _features(ticks), _tick_times(ticks), _lateness(ticks)]


def other_charts(ticks: Ticks) -> list[Chart]:
    """Return charts of the plugins' signals that `main_charts` leaves out."""
    taken = {name for _, names in _GROUPS for name in names} | set(_POSE)
    groups: dict[tuple[str, str, bool], list[str]] = {}
    for name in _signals(ticks):
        plugin, _, short = name.partition(".")
        if short in taken:
            continue
        values = ticks.numbers[name][np.isfinite(ticks.numbers[name])]
        is_count = bool(values.max() > _FEW and (values == np.round(values)).all())
        groups.setdefault((plugin, ticks.units[name], is_count), []).append(name)
    return [
        _chart(ticks, plugin, names[first : first + _MOST_LINES])
        for (plugin, _, _), names in groups.items()
        for first in range(0, len(names), _MOST_LINES)
    ]


def estimated_pose(ticks: Ticks) -> tuple[Array, Array, Array] | None:
    """Return x, y (m) and φ (rad) as an estimator found them, None where there is none."""
    names = [_find(ticks, name) for name in _POSE]
    x, y, phi = (ticks.numbers[name] if name else None for name in names)
    return None if x is None or y is None or phi is None else (x, y, phi)


# --- the parts of `main_charts` ------------------------------------------------------------------


def _pose_charts(ticks: Ticks) -> Iterator[Chart]:
    x, y, phi = ticks.pose()
    source = "true" if ticks.pose_source == "true" else "odometry"
    position = [Line(f"x {source}", x, 0), Line(f"y {source}", y, 1)]
    heading = [Line(f"φ {source}", np.degrees(phi), 2)]
    if estimated_pose(ticks) is not None:
        position += [_line(ticks, name, k + 3) for k, name in enumerate(("x", "y"))]
        heading += [_line(ticks, "phi", 5)]
    yield Chart("position of the camera", "m", ticks.t, position)
    yield Chart("heading of the camera", "deg", ticks.t, heading)


def _error_charts(ticks: Ticks) -> Iterator[Chart]:
    """Yield estimate minus truth, where both are known."""
    pose = estimated_pose(ticks)
    if pose is None or ticks.pose_source != "true":
        return
    differences = [found - true for found, true in zip(pose, ticks.pose(), strict=True)]
    turn = np.degrees((differences[2] + np.pi) % (2.0 * np.pi) - np.pi)
    sds = [_sd_of(ticks, _find(ticks, name)) for name in _POSE]
    lines = [Line(f"{_POSE[k]}", 1e3 * differences[k], k + 3, _times(sds[k], 1e3)) for k in (0, 1)]
    yield Chart("error of the estimated position", "mm", ticks.t, lines)
    line = Line("φ", turn, 5, _times(sds[2], 180.0 / np.pi))
    yield Chart("error of the estimated heading", "deg", ticks.t, [line])


def _input_charts(ticks: Ticks) -> Iterator[Chart]:
    for name, symbol, unit, scale in (
        ("v", "v", "m/s", 1.0),
        ("omega", "ω", "deg/s", 180.0 / np.pi),
    ):
        wanted, sent, found = (
            scale * ticks.numbers[f"{name}_{which}"] for which in ("wanted", "sent", "odometry")
        )
        lines = [
            Line("measured", found, 2),
            Line("asked for", wanted, 1, style="dashed"),
            Line("sent", sent, 0, style="step"),
        ]
        yield Chart(f"input {symbol}", unit, ticks.t, lines)


def _features(ticks: Ticks) -> Chart:
    lines = [Line("in all three views", ticks.numbers["features"], 0)]
    return Chart("features", "number", ticks.t, lines, from_zero=True)


def _tick_times(ticks: Ticks) -> Chart:
    lines = [Line(name, ticks.numbers[name], k) for k, name in enumerate(STAGES[:-1])]
    return Chart("time of a tick, stage by stage", "ms", ticks.t, lines, stacked=True)


def _lateness(ticks: Ticks) -> Chart:
    missed = int(np.nansum(ticks.numbers["missed"]))
    lines = [Line("lateness", ticks.numbers["lateness"], 0)]
    title = f"lateness of a tick, {missed} missed"
    return Chart(title, "ms", ticks.t, lines, from_zero=True)


# --- signals of plugins --------------------------------------------------------------------------


def _signals(ticks: Ticks) -> list[str]:
    """Return the plugins' columns that hold anything, standard deviations of others left out."""
    return [
        name
        for name, values in ticks.numbers.items()
        if "." in name
        and np.isfinite(values).sum() > 1
        and not (name.endswith(_SD) and name.removesuffix(_SD) in ticks.numbers)
    ]


def _find(ticks: Ticks, short: str) -> str:
    """Return the column of a signal, whichever plugin has it; empty where there is none."""
    names = (name for name in _signals(ticks) if name.partition(".")[2] == short)
    return next(names, "")


def _group(ticks: Ticks, title: str, shorts: Sequence[str]) -> Chart | None:
    names = [name for name in (_find(ticks, short) for short in shorts) if name]
    return _chart(ticks, title, names) if names else None


def _chart(ticks: Ticks, title: str, names: Sequence[str]) -> Chart:
    shorts = [name.partition(".")[2] for name in names]
    lines = []
    for k, (name, short) in enumerate(zip(names, shorts, strict=True)):
        base = _base(short)
        # A reference has the colour of what is to follow it.
        colour = shorts.index(base) if base in shorts else k
        lines.append(_as_line(ticks, name, colour, "solid" if base == short else "dashed"))
    unit = ticks.units[names[0]].replace("rad", "deg")
    return Chart(title, "" if unit == "1" else unit, ticks.t, lines)


def _base(name: str) -> str:
    """Return the name of the signal that a reference is one for; other names stay."""
    for mark in _REFERENCES:
        plain = name.replace(mark, "")
        if plain != name:
            return plain
    return name


def _line(ticks: Ticks, short: str, colour: int) -> Line:
    found = _as_line(ticks, _find(ticks, short), colour, "solid")
    return Line(f"{found.name} estimated", found.values, colour, found.sd, "dashed")


def _as_line(ticks: Ticks, name: str, colour: int, style: str) -> Line:
    scale = 180.0 / np.pi if ticks.units[name].startswith("rad") else 1.0
    short = name.partition(".")[2]
    base = _base(short)
    label = _SYMBOLS.get(base, base.replace("_", " ")) + (" wanted" if base != short else "")
    sd = _times(_sd_of(ticks, name), scale)
    return Line(label, scale * ticks.numbers[name], colour, sd, style)


def _sd_of(ticks: Ticks, name: str) -> Array | None:
    sd = ticks.numbers.get(name + _SD)
    return sd if sd is not None and np.isfinite(sd).any() else None


def _times(values: Array | None, scale: float) -> Array | None:
    return None if values is None else scale * values
