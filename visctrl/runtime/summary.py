"""The outcome of a run in numbers."""

from __future__ import annotations

import math
import platform
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from typing import Any, ClassVar

import numpy as np

import visctrl
from hal.types import Pose
from visctrl.runtime.consistency import ConsistencyMeter
from visctrl.runtime.loop import Tally
from visctrl.runtime.plan import Plan
from visctrl.runtime.records import COMPUTE, STAGES, Observer, TickRecord

REACHED, MISSED, LOST, STOPPED, FAULT = "reached", "missed", "lost", "stopped", "fault"

_PACKAGES = {
    "numpy": "numpy",
    "opencv": "opencv-python-headless",
    "pybullet": "pybullet",
    "scipy": "scipy",
}
_MS = 1000.0


@dataclass(frozen=True)
class End:
    """How a run ended.

    details : traceback of a fault, for a file; not for the user's eyes.
    """

    status: str
    reason: str
    exit_code: int
    details: str = ""


class Meter(Observer):
    """Collects what the summary is made of, a few numbers a tick."""

    #: But for what `Consistency` says, which is always there.
    reads_signals: ClassVar[bool] = False

    def __init__(self) -> None:
        self.lateness = array("d")
        self._seconds = array("d")
        self.features = array("l")
        self.consistency = ConsistencyMeter()
        self.path_length = 0.0
        self.last: TickRecord | None = None
        self._position: tuple[float, float] | None = None

    def on_tick(self, record: TickRecord) -> None:
        """Take a tick into account."""
        self.lateness.append(record.tick.lateness)
        self._seconds.extend(record.seconds)
        if record.stage == "main":
            self.features.append(len(record.views))
        self.consistency.on_tick(record)
        self.move_to(record.truth or record.odometry.pose)
        self.last = record

    def move_to(self, pose: Pose) -> None:
        """Lengthen the path by the way to ``pose``."""
        here = (pose.x, pose.y)
        if self._position is not None:
            self.path_length += math.dist(here, self._position)
        self._position = here

    def few_features(self) -> dict[str, int | float | None]:
        """Return the least and the median number of features in the main stage."""
        if not len(self.features):
            return {"min": None, "median": None}
        return {"min": min(self.features), "median": float(np.median(self.features))}

    @property
    def parts(self) -> dict[str, array[float]]:
        """What each part of the tick but the last took, per tick (s)."""
        names = STAGES[:-1]
        return {name: self._seconds[k :: len(names)] for k, name in enumerate(names)}

    def compute(self) -> Sequence[float]:
        """Return what the plugins took, per tick (s)."""
        parts = self.parts
        return list(map(sum, zip(*(parts[name] for name in COMPUTE), strict=True)))


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
        "lateness_ms": spread_ms(meter.lateness),
        "compute_ms": spread_ms(meter.compute()),
        "stages_ms": {name: spread_ms(values) for name, values in meter.parts.items()},
        "real_time_factor": duration / wall if wall > 0.0 else None,
        "features": meter.few_features(),
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


def spread_ms(seconds: Sequence[float]) -> dict[str, float | None]:
    """Return median, 99th percentile and maximum of durations, in ms; None without any."""
    if not len(seconds):
        return {"median": None, "p99": None, "max": None}
    ms = np.sort(_MS * np.asarray(seconds, dtype=np.float64))
    last = len(ms) - 1
    # A tenth of what `numpy.percentile` takes.
    median, p99 = np.interp((0.5 * last, 0.99 * last), np.arange(len(ms)), ms).tolist()
    return {"median": median, "p99": p99, "max": float(ms[last])}
