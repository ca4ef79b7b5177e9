"""The trifocal laws beside each other: error, time and chatter under what spoils real runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visctrl.reproduce.cases import LAW_ALONE, Summary, column, distances, folder_name, start_at
from visctrl.reproduce.entry import Bench, Row, within
from visctrl.reproduce.main_job import seeded_starts
from visctrl.studies.run_spec import RunSpec

_REAL = ("mock.noise_px=0.3", "mock.actuation.delay_s=0.1")
#: What each condition lays over an exact robot with an exact camera.
CONDITIONS: dict[str, tuple[str, ...]] = {
    "0.3 px, 0.1 s late": _REAL,
    "1 px": ("mock.noise_px=1", "mock.actuation.delay_s=0.1"),
    "0.3 s late": ("mock.noise_px=0.3", "mock.actuation.delay_s=0.3"),
    "0.5 s late": ("mock.noise_px=0.3", "mock.actuation.delay_s=0.5"),
    "10 % slip": (*_REAL, "mock.actuation.slip_v=0.1", "mock.actuation.slip_omega=0.1"),
    "20 % slip": (*_REAL, "mock.actuation.slip_v=0.2", "mock.actuation.slip_omega=0.2"),
    "scale 30 % off": (*_REAL, "estimator.scale=given", "estimator.scale_m=1.3"),
    "centre 5 px off": (*_REAL, "camera_error.cx_px=5", "camera_error.cy_px=-5"),
}
_PUBLISHED = "trifocal-smc, as published"
#: ``trifocal-smc`` turns to the target first, as it must; the others need not.
_LAWS = {
    "trifocal-smc": ("approach.enabled=true",),
    _PUBLISHED: ("approach.enabled=true", "controller.law=published"),
    "trifocal-smooth": ("approach.enabled=false",),
    "trifocal-super-twisting": ("approach.enabled=false",),
}
_STARTS = seeded_starts(8, seed=7)
#: What each law is judged by; the others are shown.
_BOUNDS = {
    "trifocal-smooth": {"worst_cm": 1.5, "median_deg": 0.1},
    "trifocal-super-twisting": {"worst_cm": 1.5, "median_deg": 0.2},
}
_KEYS = ("median_cm", "worst_cm", "median_deg", "time_s", "v_variation", "omega_variation")


def laws(bench: Bench) -> list[Row]:
    """Drive from eight seeded starts under each condition, with every law of the scheme."""
    jobs = [
        _job(bench, law, condition, number)
        for condition in CONDITIONS
        for law in _LAWS
        for number in range(len(_STARTS))
    ]
    summaries = bench.run(jobs)
    shape = (len(CONDITIONS), len(_LAWS), len(_STARTS))
    numbers = np.array([_numbers(s, j.out) for s, j in zip(summaries, jobs, strict=True)])
    rows: list[Row] = []
    for condition, runs in zip(CONDITIONS, numbers.reshape(*shape, 5), strict=True):
        by_law = dict(zip(_LAWS, map(_collected, runs), strict=True))
        sliding, source = by_law["trifocal-smc"], by_law.pop(_PUBLISHED)
        better = {key: sliding[key] for key in ("time_s", "v_variation", "omega_variation")}
        for law, ours in by_law.items():
            case, bound = f"{condition}: {law}", _BOUNDS.get(law, {})
            if law == "trifocal-smooth":
                bound = bound | better
            if bound:
                rows.append(within(case, bound, ours, source=source))
            else:
                rows.append(Row(case, ours, source=source))
    return rows


def _job(bench: Bench, law: str, condition: str, number: int) -> RunSpec:
    settings = (
        *("backend=mock", f"controller.name={law.partition(',')[0]}", f"seed={number}"),
        *_LAWS[law],
        *("mock.near_m=1.5", "mock.far_m=5"),
        LAW_ALONE,
        *start_at(_STARTS[number]),
        *CONDITIONS[condition],
    )
    return RunSpec("default", settings, bench.out / folder_name(law, condition, str(number)))


def _numbers(summary: Summary, directory: Path | None) -> list[float]:
    """Return error (cm, deg), duration (s) and the last quarter's variation of v and ω."""
    position, heading = distances(summary).values()
    return [position, heading, summary["duration_s"], *last_variation(directory)]


def last_variation(directory: Path | None) -> tuple[float, float]:
    """Return the total variation of v (m/s) and ω (rad/s) over the last quarter of a run."""
    quarters = (column(directory, name) for name in ("v_sent", "omega_sent"))
    v, omega = (float(np.abs(np.diff(x[3 * len(x) // 4 :])).sum()) for x in quarters)
    return v, omega


def _collected(runs: NDArray[np.float64]) -> dict[str, float]:
    """Return what runs (N, 5) have in common: medians, and the worst position."""
    position, heading, time, v, omega = np.median(runs, axis=0).tolist()
    values = (position, float(runs[:, 0].max()), heading, time, v, omega)
    return dict(zip(_KEYS, values, strict=True))
