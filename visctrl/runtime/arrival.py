"""The arrival check in a run: what it is told on the way, and what it says at the end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

from visctrl.contracts import Match, Perception, Views
from visctrl.hal.interfaces import Backend
from visctrl.hal.types import Frame, Odometry, Pose
from visctrl.robots.unicycle import wrapped
from visctrl.runtime.plan import Plan
from visctrl.runtime.records import Observer, TickRecord
from visctrl.schemes.arrival.centre import centre_of_turns
from visctrl.schemes.arrival.check import LEAST_SHARE, Answer, ArrivalCheck, Tolerance, Verdict
from visctrl.schemes.arrival.way import seen_displacement

#: Frames of named features that are judged together, at the target and here, and how long to
#: wait for them (ticks).
TAUGHT, _FRAMES, _WAIT = 9, 8, 16
#: Starts nearer than this share of what is left at an end may be.
_BEGINS = 0.75
#: Starts turned by more than this may look far off and be near.
_TURNED_RAD = math.radians(20.0)
#: What noise may leave of a place at which the last stage begins (m).
_KNOWN_M = 0.1
#: Between two views that are remembered, the robot has driven (m) or turned (rad) so far.
_STEP_M, _STEP_RAD = 0.05, math.radians(10.0)


class ArrivalWatch(Observer):
    """Remembers views on the way and judges the last one.

    Parameters
    ----------
    plan : Plan
        Of the run.
    """

    reads_signals: ClassVar[bool] = False

    def __init__(self, plan: Plan) -> None:
        tolerance = plan.scenario.tolerance
        self._check = ArrivalCheck(
            plan.camera,
            plan.mount.height_m,
            Tolerance(tolerance.position_m, math.radians(tolerance.heading_deg)),
        )
        self._calibration = plan.camera
        self._forward = plan.mount.forward_m
        self._period = plan.period_s
        self._within = plan.scenario.final.within_m
        self._last: Pose | None = None
        self._newest: tuple[Views, Pose] | None = None

    def set_target(self, frames: Sequence[Frame]) -> None:
        """Prepare the target."""
        self._check.set_target(frames)

    def on_initial(self, frame: Frame, match: Match) -> None:
        """Look at what is where the target has it although the robot is elsewhere."""
        self._check.set_initial(frame)

    def on_tick(self, record: TickRecord) -> None:
        """Remember the view where the robot has moved on."""
        camera = self._camera(record.odometry)
        self._newest = record.views, camera
        if self._last is not None:
            driven = math.hypot(camera.x - self._last.x, camera.y - self._last.y)
            if driven < _STEP_M and abs(wrapped(camera.phi - self._last.phi)) < _STEP_RAD:
                return
        self._last = camera
        self._check.pass_by(record.views, camera)

    def begins_near(self, perception: Perception[Any], frame: Frame) -> bool:
        """Return whether the robot starts where the image alone shall guide it.

        How far that is without any scale, a usual scene's depth tells. A wrong image centre makes
        a turn look like a way: where it may be that, a turn back on the spot will tell.
        """
        views = perception.update(frame)
        left = seen_displacement(views)
        if left is None:
            return False
        near = _BEGINS * self._within
        if left.distance >= near and abs(left.pose.phi) > _TURNED_RAD:
            centre = centre_of_turns(self._calibration, views.target, [views.current], views.sigma)
            left = left if centre.far_off else seen_displacement(centre.corrected(views))
        # What views do not determine is no place to begin from.
        return left is not None and left.distance < near and left.noise_sd < _KNOWN_M

    def may_coincide(self, verdict: Verdict) -> bool:
        """Return whether something is left that the image alone can close."""
        near = verdict.left is not None and verdict.left.distance < self._within
        return verdict.answer is not Answer.THERE and verdict.agree >= LEAST_SHARE and near

    def judge(self, backend: Backend) -> Verdict:
        """Take frames of the robot, which stands, and compare them with the target."""
        frames = [backend.camera.read()]
        for _ in range(_WAIT):
            # A picture is exact enough alone; features are averaged.
            if frames[0].image is not None or len(frames) == _FRAMES:
                break
            backend.clock.sleep_until(backend.clock.now() + self._period)
            frame = backend.camera.read()
            if frame.sequence != frames[-1].sequence:
                frames.append(frame)
        if self._newest is not None:
            self._check.pass_by(*self._newest)
        return self._check.judge(frames)

    def _camera(self, odometry: Odometry) -> Pose:
        """Return where the wheels say the camera is."""
        x, y, phi = odometry.pose
        ahead = self._forward
        return Pose(x - ahead * math.sin(phi), y + ahead * math.cos(phi), phi)


def reported(verdict: Verdict | None) -> dict[str, Any] | None:
    """Return a verdict as the summary holds it; None where nothing was judged."""
    if verdict is None:
        return None
    numbers: dict[str, Any] = {
        "answer": verdict.answer.value,
        "features": verdict.features,
        "found": verdict.found,
        "agree": verdict.agree,
        "coincide": verdict.coincide,
        "left": None,
    }
    if verdict.left is not None:
        (x, y, phi), covariance = verdict.left.pose, verdict.left.covariance
        x_sd, y_sd, phi_sd = (math.sqrt(max(0.0, float(covariance[k, k]))) for k in range(3))
        numbers["left"] = {
            "x_m": x,
            "y_m": y,
            "phi_deg": math.degrees(phi),
            "x_sd_m": x_sd,
            "y_sd_m": y_sd,
            "phi_sd_deg": math.degrees(phi_sd),
            "distance_m": verdict.left.distance,
            "distance_sd_m": verdict.left.distance_sd,
        }
    return numbers
