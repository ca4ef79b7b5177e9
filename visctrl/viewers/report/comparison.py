"""Several runs on one page: table, overlaid paths and signals, what differed in their settings."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from visctrl.contracts import Array
from visctrl.hal.types import Pose
from visctrl.robots.errors import InputError
from visctrl.runtime.records import COMPUTE
from visctrl.viewers.report.page import page, section, table, verdict
from visctrl.viewers.report.run_report import RunFiles, numbers, read_run, save
from visctrl.viewers.report.svg import COLOURS, Chart, Line, draw_chart
from visctrl.viewers.report.ticks import Ticks
from visctrl.viewers.report.topview import DrivenPath, draw_paths


def write_comparison(directories: Sequence[Path], target: Path) -> Path:
    """Write a page that compares runs and return its path.

    Parameters
    ----------
    directories : sequence of Path
        At least one run directory.
    target : Path
        The page.

    Raises
    ------
    InputError
        A run cannot be read, or the page cannot be written; the message names the file.
    """
    runs = [read_run(directory) for directory in directories]
    named = list(zip(_names(directories), runs, strict=True))
    body = (
        f"<header><h1>{len(runs)} runs compared</h1></header>{_table(named)}"
        + section(
            "Paths and signals", f'<div class="overview">{_paths(named)}{_charts(named)}</div>'
        )
        + _differences(named)
    )
    save(target, page("visctrl: runs compared", body))
    return target


def _names(directories: Sequence[Path]) -> list[str]:
    """Return the directories' names, with their parents' where two are the same."""
    resolved = [Path(os.path.realpath(path)) for path in directories]
    for depth in range(1, max(len(path.parts) for path in resolved) + 1):
        names = ["/".join(path.parts[-depth:]) for path in resolved]
        if len(set(names)) == len(names):
            return names
    raise InputError("a run is named twice: compare different runs")


def _table(named: Sequence[tuple[str, RunFiles]]) -> str:
    described = [numbers(run.summary) for _, run in named]
    columns = list(dict.fromkeys(name for row in described for name in row))
    rows = []
    for k, ((name, run), row) in enumerate(zip(named, described, strict=True)):
        reason = escape(run.summary.get("reason", ""))
        rows.append(
            [
                f'<span class="key c{k % COLOURS}"><i></i>{escape(name)}</span>',
                f'<span title="{reason}">{verdict(run.summary["status"])}</span>',
                *(escape(str(run.config.get(key, ""))) for key in ("scheme", "backend", "seed")),
                *(escape(row.get(column, "")) for column in columns),
            ]
        )
    return table(("run", "ended", "scheme", "backend", "seed", *columns), rows)


def _paths(named: Sequence[tuple[str, RunFiles]]) -> str:
    paths = [
        DrivenPath(name, run.ticks.t, *run.ticks.pose(), colour=k % COLOURS)
        for k, (name, run) in enumerate(named)
    ]
    known = all(run.ticks.pose_source == "true" for _, run in named)
    target = Pose(0.0, 0.0, 0.0) if known else None
    return draw_paths(paths, None, target, caption="paths" if known else "paths, some by odometry")


def _charts(named: Sequence[tuple[str, RunFiles]]) -> str:
    charts = (
        ("distance to the target", "m", _distance),
        ("heading against the target's", "deg", _heading),
        ("input v, sent", "m/s", lambda ticks: ticks.numbers["v_sent"]),
        ("input ω, sent", "deg/s", lambda ticks: ticks.degrees("omega_sent")),
        ("features", "number", lambda ticks: ticks.numbers["features"]),
        ("perception, estimation and control", "ms", _compute),
    )
    drawn = (draw_chart(_overlaid(named, *chart)) for chart in charts)
    return f'<div class="charts">{"".join(drawn)}</div>'


def _overlaid(
    named: Sequence[tuple[str, RunFiles]],
    title: str,
    unit: str,
    values: Callable[[Ticks], Array],
) -> Chart:
    """Return one line a run; all share the times of the longest run's ticks."""
    longest = max((run.ticks for _, run in named), key=lambda ticks: _last(ticks.t))
    lines = [
        Line(name, _at(longest.t, run.ticks.t, values(run.ticks)), k % COLOURS)
        for k, (name, run) in enumerate(named)
    ]
    return Chart(title, unit, longest.t, lines)


def _last(t: Array) -> float:
    return float(t[-1]) if len(t) else 0.0


def _at(t: Array, times: Array, values: Array) -> Array:
    if not len(times):
        return np.full(len(t), np.nan)
    return np.interp(t, times, values, right=np.nan)


def _distance(ticks: Ticks) -> Array:
    return np.asarray(np.hypot(ticks.numbers["x_true"], ticks.numbers["y_true"]))


def _heading(ticks: Ticks) -> Array:
    return ticks.degrees("phi_true")


def _compute(ticks: Ticks) -> Array:
    return np.asarray(sum(ticks.numbers[name] for name in COMPUTE))


def _differences(named: Sequence[tuple[str, RunFiles]]) -> str:
    """Return tables of the settings that are not the same in all runs, or not in all runs."""
    flat = [dict(_flattened(run.config)) for _, run in named]
    keys = dict.fromkeys(key for settings in flat for key in settings)
    shared: list[list[str]] = []
    others: list[list[str]] = []
    for key in keys:
        values = [settings.get(key, "") for settings in flat]
        rows = shared if all(key in settings for settings in flat) else others
        if rows is others or len(set(values)) > 1:
            rows.append([escape(key), *map(escape, values)])
    header = ("key", *(name for name, _ in named))
    text = table(header, shared) if shared else "<p>None: the runs had the same settings.</p>"
    found = section("Settings that differ", text)
    if others:
        found += section("Settings that only some runs have", table(header, others), closed=True)
    return found


def _flattened(data: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield from _flattened(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", "" if value is None else str(value)
