"""``visctrl observability``: what a motion tells of the pose, and when it tells too little."""

from __future__ import annotations

import csv
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.observability import (
    Output,
    discrete_matrix,
    lie_matrix,
    rank,
    singular_values,
    stripped_matrix,
    unobservable,
)
from visctrl.geometry.pose_outputs import epipole_bearings, normalised_elements
from visctrl.geometry.trifocal.tensor import ELEMENTS
from visctrl.planning.paths import ParabolicPath
from visctrl.robots.errors import InputError
from visctrl.robots.files import replacing, writing

Array = NDArray[np.float64]

_NAMES = ("epipoles", "target-epipole", *(name for name in ELEMENTS if name != "T121"))
#: Singular values below this share of the largest one count as lost.
_LOST = 1e-4
#: Largest coordinate of a start (m, deg), and longest planned path.
_FARTHEST, _MOST_TICKS = 1000.0, 100_000


def observability(
    run: Path | None,
    start: tuple[float, float, float] | None,
    outputs: list[str],
    *,
    tau_s: float,
    period_s: float,
    window: int,
    offset_m: float,
    as_json: bool,
    out: Path | None,
) -> int:
    """Judge a recorded run, or the path planned from a start; return 0.

    Raises
    ------
    InputError
        Neither or both are given, an unknown output, or a log that cannot be used.
    """
    if start is not None and not all(abs(value) <= _FARTHEST for value in start):
        raise InputError(f"--start: expected three numbers, none beyond {_FARTHEST:g}")
    if tau_s / period_s > _MOST_TICKS:
        raise InputError(
            f"--tau {tau_s:g}: more than {_MOST_TICKS:,} ticks of --period {period_s:g} s"
        )
    if (run is None) == (start is None):
        raise InputError("give either a run directory or --start X Y PHI_DEG")
    for name in outputs:
        if name not in _NAMES:
            raise InputError(f"--output {name}: unknown; known: {', '.join(_NAMES)}")
    if run is not None:
        times, poses, velocities = _recorded(run)
    else:
        assert start is not None
        times, poses, velocities = _planned(start, tau_s, period_s, offset_m)
    chosen = outputs or ["epipoles", "target-epipole", "T111", "T211"]
    length = max(float(np.hypot(*poses[0][:2])), 1.0)
    rows: list[dict[str, Any]] = []
    report = []
    for name in chosen:
        found = _judged(_output(name, poses[0]), times, poses, velocities, window, length, offset_m)
        rows += [{"output": name, **row} for row in found]
        report.append(_summary(name, found))
    if out is not None:
        _write(out, rows)
    if as_json:
        print(json.dumps(report, indent=2))
    else:
        _show(report)
    return 0


def _output(name: str, initial: Array) -> Output:
    if name == "epipoles":
        return lambda pose: epipole_bearings(pose, np.zeros(3))
    if name == "target-epipole":

        def target(pose: Array) -> tuple[Array, Array]:
            value, slope = epipole_bearings(pose, np.zeros(3))
            return value[..., :1], slope[..., :1, :]

        return target
    k = ELEMENTS.index(name)

    def element(pose: Array) -> tuple[Array, Array]:
        value, slope = normalised_elements(pose, initial)
        return value[..., [k]], slope[..., [k], :]

    return element


def _judged(
    output: Output,
    times: Array,
    poses: Array,
    velocities: Array,
    window: int,
    length: float,
    offset: float,
) -> list[dict[str, Any]]:
    """Return ranks and smallest singular values in windows along a motion."""
    rows = []
    for first in range(0, len(times) - window, window):
        part = slice(first, first + window)
        dt = float((times[first + window] - times[first]) / window)
        pose, steps = poses[first], velocities[part]
        matrix = discrete_matrix(output, pose, steps, dt, offset)
        believed = stripped_matrix(output, pose, steps, dt, offset)
        if not (np.isfinite(matrix).all() and np.isfinite(believed).all()):
            continue
        values = singular_values(matrix, length)
        rows.append(
            {
                "t_s": float(times[first]),
                "rank": rank(matrix, length, _LOST),
                "rank_instant": rank(lie_matrix(output, pose, offset), length, _LOST),
                "rank_filter": rank(believed, length, _LOST),
                "least_singular_value": float(values[-1]),
                "lost": [d.tolist() for d in unobservable(matrix, length, _LOST)],
            }
        )
    return rows


def _summary(name: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    lost = [row["t_s"] for row in rows if row["rank"] < 3]
    values = [row["least_singular_value"] for row in rows]
    at = int(np.argmin(values)) if values else 0
    return {
        "output": name,
        "windows": len(rows),
        "windows_lost": len(lost),
        "first_lost_s": lost[0] if lost else None,
        "last_lost_s": lost[-1] if lost else None,
        "locally_weakly_observable": sum(row["rank_instant"] == 3 for row in rows),
        "filter_believes": sum(row["rank_filter"] == 3 for row in rows),
        "least_singular_value": values[at] if values else None,
        "least_at_s": rows[at]["t_s"] if rows else None,
        "lost_direction": next((row["lost"][0] for row in rows if row["lost"]), None),
    }


def _show(report: list[dict[str, Any]]) -> None:
    print("windows of the motion in which the pose (x, y, phi) is told; singular values per radian")
    for entry in report:
        told = entry["windows"] - entry["windows_lost"]
        least, at = entry["least_singular_value"], entry["least_at_s"]
        line = f"{entry['output']:<15} {told} of {entry['windows']} windows"
        if least is not None:
            line += f", least singular value {least:.2e} at {at:.1f} s"
        if entry["windows_lost"]:
            line += f"; lost first at {entry['first_lost_s']:.1f} s"
            x, y, phi = entry["lost_direction"]
            line += f", direction ({x:+.2f}, {y:+.2f}, {phi:+.2f})"
        line += f"; locally weakly observable in {entry['locally_weakly_observable']}"
        print(f"{line}, an EKF believes to see it in {entry['filter_believes']}")


def _recorded(run: Path) -> tuple[Array, Array, Array]:
    """Return times, poses and velocities of the main stage of a recorded run."""
    from visctrl.viewers.report.ticks import read_ticks

    path = run / "ticks.csv" if os.path.isdir(run) else run
    if not os.path.isfile(path):
        raise InputError(f"{run}: holds no ticks.csv: name the directory of a run")
    ticks = read_ticks(path)
    names = ("t", "x_true", "y_true", "phi_true", "v_sent", "omega_sent")
    if missing := [name for name in names if name not in ticks.numbers]:
        raise InputError(f"{path}: has no column {', '.join(missing)}")
    table = np.stack([np.asarray(ticks.numbers[name], dtype=np.float64) for name in names], axis=1)
    main = np.array([stage == "main" for stage in ticks.words["stage"]])
    table = table[main & np.isfinite(table).all(axis=1)]
    if len(table) < 3:
        raise InputError(f"{path}: too few ticks with a true pose: record a simulated run")
    return table[:, 0], table[:, 1:4], table[:, 4:]


def _planned(
    start: tuple[float, float, float], tau_s: float, period_s: float, offset: float
) -> tuple[Array, Array, Array]:
    """Return the motion along the parabola from a start to the target, under the control law."""
    from visctrl.robots.unicycle import arc

    x, y, phi = start[0], start[1], math.radians(start[2])
    if y >= 0.0:
        raise InputError(f"--start: y = {y:g} m is not before the target: choose y < 0")
    path = ParabolicPath((x, y), (0.0, 0.0))
    times = np.arange(0.0, tau_s, period_s)
    poses, velocities = [], []
    for t in times.tolist():
        reference = path.at(t, tau_s)
        nu = [
            rate - (here - wanted)
            for rate, here, wanted in zip(
                reference.velocity, (x, y), reference.position, strict=True
            )
        ]
        s, c = math.sin(phi), math.cos(phi)
        v, omega = -s * nu[0] + c * nu[1], -(c * nu[0] + s * nu[1]) / offset
        poses.append((x, y, phi))
        velocities.append((v, omega))
        step = arc(phi, v, omega, period_s, offset)
        x, y, phi = x + step.dx, y + step.dy, phi + step.turn
    return times, np.array(poses), np.array(velocities)


def _write(out: Path, rows: list[dict[str, Any]]) -> None:
    with (
        writing(out),
        replacing(out) as fresh,
        fresh.open("w", newline="", encoding="utf-8") as file,
    ):
        names = [name for name in rows[0] if name != "lost"] if rows else []
        writer = csv.DictWriter(file, names, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
