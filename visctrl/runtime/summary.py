"""The outcome of a run in numbers."""

from __future__ import annotations

import math
import platform
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from typing import Any

import visctrl
from visctrl.hal.types import Pose
from visctrl.runtime.loop import Tally
from visctrl.runtime.meter import PARTS, Meter
from visctrl.runtime.plan import Plan

REACHED, MISSED, LOST, STOPPED, FAULT = "reached", "missed", "lost", "stopped", "fault"

_PACKAGES = {
    "numpy": "numpy",
    "opencv": "opencv-python-headless",
    "pybullet": "pybullet",
    "scipy": "scipy",
}


@dataclass(frozen=True)
class End:
    """How a run ended.

    details : traceback of a fault, for a file; not for the user's eyes.
    """

    status: str
    reason: str
    exit_code: int
    details: str = ""


def judge(plan: Plan, finished: bool, truth: Pose | None, collisions: int) -> End:
    """Return how a run that went to its end has ended.

    ``reached`` needs the controller's own termination test, no contact with anything, and,
    where the truth is known, a final pose within the tolerance.
    """
    if collisions:
        return End(MISSED, f"the robot touched something ({collisions} contacts)", 1)
    if not finished:
        allowed = f"{plan.scenario.duration_s:g} s"
        return End(MISSED, f"the controller had not finished after {allowed}", 1)
    if truth is None:
        return End(REACHED, "the controller finished; the true pose is not known", 0)
    tolerance = plan.scenario.tolerance
    distance, heading = math.hypot(truth.x, truth.y), abs(math.degrees(truth.phi))
    where = f"{100.0 * distance:.2f} cm and {heading:.2f} deg from the target"
    if distance <= tolerance.position_m and heading <= tolerance.heading_deg:
        return End(REACHED, f"the controller finished {where}", 0)
    return End(MISSED, f"the controller finished, but {where}", 1)


def summarise(
    plan: Plan,
    end: End,
    meter: Meter,
    tally: Tally,
    truth: Pose | None,
    timing: tuple[float, float],
) -> dict[str, Any]:
    """Return the summary that ``--json`` prints and ``summary.json`` holds.

    Parameters
    ----------
    plan, end, meter, tally
        What ran, how it ended, what was measured and counted.
    truth : Pose or None
        Final true pose.
    timing : (duration, wall)
        Seconds on the backend's clock and on the wall's, first tick to standstill.
    """
    scenario = plan.scenario
    duration, wall = timing
    return {
        "status": end.status,
        "reason": end.reason,
        "backend": scenario.backend,
        "scheme": scenario.scheme,
        "robot": scenario.robot,
        "camera": plan.camera.name,
        "seed": scenario.seed,
        "final_error": None
        if truth is None
        else {"x_m": truth.x, "y_m": truth.y, "phi_deg": math.degrees(truth.phi)},
        "path_length_m": meter.path_length,
        "duration_s": duration,
        "period_s": plan.period_s,
        "ticks": tally.ticks,
        "missed_ticks": tally.missed,
        "lateness_ms": meter.spread_ms("lateness"),
        "compute_ms": meter.spread_ms("compute"),
        "stages_ms": {name: meter.spread_ms(name) for name in PARTS},
        "real_time_factor": duration / wall if wall > 0.0 else None,
        "features": meter.features(),
        "consistency": meter.consistency.summary(),
        "versions": versions(),
    }


@cache
def versions() -> dict[str, str]:
    """Return the versions of this program and of what its results depend on."""
    found = {"visctrl": visctrl.__version__, "python": platform.python_version()}
    for name, package in _PACKAGES.items():
        try:
            found[name] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found
