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
from visctrl.runtime.arrival import reported
from visctrl.runtime.loop import Tally
from visctrl.runtime.meter import PARTS, Meter
from visctrl.runtime.plan import Plan
from visctrl.schemes.arrival.check import Answer, Verdict

REACHED, MISSED, DOUBTFUL = "reached", "missed", "doubtful"
LOST, STOPPED, FAULT = "lost", "stopped", "fault"

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


@dataclass(frozen=True)
class Results:
    """What a run has left behind.

    verdict : what the picture at the end says; None where it was not looked at.
    truth : final true pose, None where unknown.
    timing : (duration, wall), seconds on the backend's clock and on the wall's, first tick to
        standstill.
    """

    meter: Meter
    tally: Tally
    verdict: Verdict | None
    truth: Pose | None
    timing: tuple[float, float]


def judge(plan: Plan, finished: bool, verdict: Verdict, collisions: int) -> End:
    """Return how a run that went to its end has ended.

    ``reached`` needs that the robot touched nothing and that the picture is the target's. The
    truth has no say: a robot does not have it.
    """
    if collisions:
        return End(MISSED, f"the robot touched something ({collisions} contacts)", 1)
    allowed = f"after {plan.scenario.duration_s:g} s"
    did = "the controller finished" if finished else f"the controller had not finished {allowed}"
    if verdict.answer is Answer.THERE:
        return End(REACHED, f"{did}, and the picture is the target's: {verdict.reason}", 0)
    if verdict.answer is Answer.ELSEWHERE:
        return End(MISSED, f"{did}, but the picture is not the target's: {verdict.reason}", 1)
    if not finished:  # neither the controller nor the picture says that the robot is there
        return End(MISSED, f"{did}, and the picture cannot tell: {verdict.reason}", 1)
    return End(DOUBTFUL, f"{did}, but the picture cannot tell: {verdict.reason}", 1)


def against_truth(plan: Plan, end: End, truth: Pose | None) -> dict[str, Any] | None:
    """Return what the truth says of a run and of its status; None where it is not known."""
    if truth is None:
        return None
    tolerance = plan.scenario.tolerance
    distance, heading = math.hypot(truth.x, truth.y), abs(math.degrees(truth.phi))
    there = distance <= tolerance.position_m and heading <= tolerance.heading_deg
    return {
        "distance_m": distance,
        "heading_deg": heading,
        "within_tolerance": there,
        "false_success": end.status == REACHED and not there,
    }


def summarise(plan: Plan, end: End, results: Results) -> dict[str, Any]:
    """Return the summary that ``--json`` prints and ``summary.json`` holds."""
    scenario = plan.scenario
    meter, tally, truth = results.meter, results.tally, results.truth
    duration, wall = results.timing
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
        "arrival": reported(results.verdict),
        "truth": against_truth(plan, end, truth),
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
