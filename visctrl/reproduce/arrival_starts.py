"""Starts near the target: the last decimetre by the image, with all that may be wrong wrong."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from visctrl.reproduce.entry import Bench, Row
from visctrl.studies.run_spec import RunSpec

#: Places on a grid of 5 cm within 30 cm; the headings are multiples of 10 deg, drawn for each.
_STEP_M, _WITHIN_M, _STEP_DEG = 0.05, 0.3, 10.0
_NOISE = ("backend=mock", "mock.noise_px=.3")
_WRONG = ("camera_error.cx_px=-20", "mock.actuation.slip_omega=.15", "mock.actuation.slip_v=.15")
#: What is laid over an exact robot with an exact camera.
CONDITIONS: dict[str, tuple[str, ...]] = {
    "0.3 px": _NOISE,
    "0.3 s late": (*_NOISE, "mock.actuation.delay_s=.3"),
    "centre 20 px of 800, gain 0.85, 0.5 s late": (
        *(*_NOISE, *_WRONG),
        "mock.actuation.delay_s=.5",
    ),
}


def places() -> list[tuple[float, float, float]]:
    """Return the starts (m, m, deg)."""
    rng = np.random.default_rng(11)
    steps = round(_WITHIN_M / _STEP_M)
    line = [_STEP_M * k for k in range(-steps, steps + 1)]
    grid = [(x, y) for x in line for y in line]
    near = [place for place in grid if math.hypot(*place) <= _WITHIN_M + 1e-9]
    return [(x, y, _STEP_DEG * float(rng.integers(-17, 19))) for x, y in near]


def arrival_starts(bench: Bench) -> list[Row]:
    """Start from every place under every condition, with the trifocal scheme."""
    rows = []
    for name, settings in CONDITIONS.items():
        runs = [
            RunSpec("default", (*settings, f"seed={number}", *_start(*place)))
            for number, place in enumerate(places())
        ]
        rows.append(row(name, bench.run(runs)))
    return rows


def _start(x: float, y: float, phi: float) -> tuple[str, ...]:
    return f"start.x_m={x:.2f}", f"start.y_m={y:.2f}", f"start.phi_deg={phi:g}"


def row(name: str, summaries: list[dict[str, Any]]) -> Row:
    """Return the share that reached, the errors and the false successes."""
    truths = [summary["truth"] for summary in summaries]
    cm = 100.0 * np.array([truth["distance_m"] for truth in truths])
    degrees = np.array([truth["heading_deg"] for truth in truths])
    ours = {
        "runs": float(len(summaries)),
        "reached": float(sum(summary["status"] == "reached" for summary in summaries)),
        "false_success": float(sum(truth["false_success"] for truth in truths)),
        "median_cm": float(np.median(cm)),
        "worst_cm": float(cm.max()),
        "worst_deg": float(degrees.max()),
        "median_s": float(np.median([summary["duration_s"] for summary in summaries])),
    }
    bound = {"worst_cm": 2.0, "worst_deg": 1.0, "false_success": 0.0}
    good = ours["reached"] == ours["runs"] and not ours["false_success"]
    good = good and ours["worst_cm"] <= 2.0 and ours["worst_deg"] <= 1.0
    return Row(name, ours, bound=bound, ok=good)
