"""Estimator of the final stage: the displacement from the target, with depths learnt on the way."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from visctrl.contracts import Context, Estimate, Estimator, Health, Signal, Views
from visctrl.hal.types import Pose, Velocity
from visctrl.robots.documents import StrictModel
from visctrl.robots.unicycle import along_arc
from visctrl.schemes.arrival.centre import TurnWatch
from visctrl.schemes.arrival.depths import composed, relative_to
from visctrl.schemes.arrival.displacement import Displacement
from visctrl.schemes.arrival.way import Passed, WayDepths, depths_on_the_way, seen_displacement

#: Between two views that are remembered, the robot has been told to drive (m) or turn (rad).
_STEP_M, _STEP_RAD = 0.06, math.radians(15.0)


class CoincidenceOptions(StrictModel):
    """Options of `CoincidenceEstimator`: none."""


@dataclass(frozen=True)
class CoincidenceEstimate(Estimate):
    """Where the camera is in the target's frame, and how certainly; None before it is known."""

    left: Displacement | None = None


class CoincidenceEstimator(Estimator[CoincidenceOptions, CoincidenceEstimate]):
    """Displacement from the bearings' differences between the current and the target view.

    It vanishes where the images coincide, however wrong calibration, wheels or depths are: these
    change its size and, a little, its direction. Every feature's depth is measured by the views
    that the stage's own manoeuvre gives, scaled by the commanded travel.
    """

    Options: ClassVar[type[CoincidenceOptions]] = CoincidenceOptions
    signals: ClassVar[tuple[Signal, ...]] = (
        Signal("x_left", "m"),
        Signal("y_left", "m"),
        Signal("phi_left", "rad"),
    )

    def __init__(self, options: CoincidenceOptions, context: Context) -> None:
        super().__init__(options, context)
        self.reset()

    def reset(self) -> None:
        """Forget where the robot was and how far things are."""
        self._axle = (0.0, 0.0, 0.0)
        self._camera = Pose(0.0, self.context.camera_forward_m, 0.0)
        self._turns = TurnWatch(self.context.camera, self.context.camera_forward_m)
        self._passed: list[Passed] = []
        self._depths: WayDepths | None = None
        self._pose: Pose | None = None

    def update(self, views: Views, sent: Velocity, dt: float) -> CoincidenceEstimate:
        """Return the displacement that a view shows."""
        before = self._camera
        self._axle = along_arc(self._axle, sent, dt)
        x, y, phi = self._axle
        ahead = self.context.camera_forward_m
        self._camera = Pose(x - ahead * math.sin(phi), y + ahead * math.cos(phi), phi)
        if self._pose is not None:
            self._pose = composed(self._pose, relative_to(before, self._camera))
        if views.health is Health.LOST:
            return CoincidenceEstimate(views.health, views.reason)
        if self._turns.add(views, self._camera.phi, sent.v * dt):
            # What was seen before was seen wrongly.
            self._passed.clear()
        views = self._turns.corrected(views)
        self._learn(views)
        depths = None if self._depths is None else self._depths.of(views.ids)
        left = seen_displacement(views, depths, self._pose)
        self._pose = self._pose if left is None else left.pose
        return CoincidenceEstimate(Health.OK, left=left)

    def notes(self) -> Sequence[str]:
        """Return where the image centre seems to be, if it is not the calibration's."""
        centre = self._turns.centre
        return [str(centre)] if centre is not None and centre.off else []

    def values(self) -> Mapping[str, float]:
        """Return the pose that is left."""
        if self._pose is None:
            return {}
        return dict(zip(("x_left", "y_left", "phi_left"), self._pose, strict=True))

    def _learn(self, views: Views) -> None:
        """Remember the view where the robot has moved on, and measure the depths anew."""
        if self._passed:
            moved = relative_to(self._passed[-1].camera, self._camera)
            if math.hypot(moved.x, moved.y) < _STEP_M and abs(moved.phi) < _STEP_RAD:
                return
        self._passed.append(Passed(views, self._camera))
        # Seen at another heading, things are elsewhere by the fault of the calibration, too.
        alike = [
            each
            for each in self._passed
            if abs(each.camera.phi - self._camera.phi) < 2.0 * _STEP_RAD
        ]
        if self._pose is not None:
            measured = depths_on_the_way(alike, self._pose)
            if len(measured.ids):
                self._depths = measured
