"""Plugins that look at nothing, for runs in which only the devices matter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from visctrl.contracts import Estimator, Health, Match, Perception, Views
from visctrl.hal.types import Frame, Pose, Velocity
from visctrl.robots.documents import StrictModel
from visctrl.robots.unicycle import step_exact
from visctrl.schemes.pose.estimate import PoseEstimate


class BlindOptions(StrictModel):
    pass


class Blind(Perception[BlindOptions]):
    """Takes any image and reports twenty features, others in every frame: it looks at nothing."""

    Options: ClassVar[type[BlindOptions]] = BlindOptions

    def set_target(self, frames: Sequence[Frame]) -> None:
        assert all(frame.image is not None for frame in frames)

    def set_initial(self, frame: Frame) -> Match:
        assert frame.image is not None
        return Match(20, 20, np.zeros((20, 2)), np.zeros((20, 2)))

    def update(self, frame: Frame) -> Views:
        rays = np.tile([0.0, 1.0, 0.0], (20, 1))
        ids = np.arange(20) + 20 * frame.sequence
        return Views(ids, rays, rays, rays, np.zeros((20, 2)), 0.001, frame.stamp)


class Reckoning(Estimator[BlindOptions, PoseEstimate]):
    """Believes that it starts 3 m before the target, and in what was sent."""

    Options: ClassVar[type[BlindOptions]] = BlindOptions

    def reset(self) -> None:
        self.pose = np.array([0.0, -3.0, 0.0])

    def update(self, views: Views, sent: Velocity, dt: float) -> PoseEstimate:
        ahead = self.context.camera_forward_m
        self.pose = step_exact(self.pose, sent.v, sent.omega, dt, ahead)
        return PoseEstimate(
            health=Health.OK,
            pose=Pose(*self.pose.tolist()),
            covariance=1e-4 * np.eye(3),
            initial=Pose(0.0, -3.0, 0.0),
        )
