"""What the pose estimators deliver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Estimate, Health, Signal
from visctrl.hal.types import Pose

Array = NDArray[np.float64]

#: What every pose estimator logs: NIS and its degrees of freedom, the pose, its deviations.
POSE_SIGNALS = (
    Signal("nis", "1"),
    Signal("nis_dof", "1"),
    Signal("x", "m"),
    Signal("y", "m"),
    Signal("phi", "rad"),
    Signal("x_sd", "m"),
    Signal("y_sd", "m"),
    Signal("phi_sd", "rad"),
)


class Need(StrEnum):
    """What an estimator wants the robot to do before its pose can be used."""

    #: Stand, while the initial view is averaged.
    STILL = "still"
    #: Drive straight ahead: the known motion gives the scale.
    FORWARD = "forward"
    #: The pose may be used.
    NOTHING = "nothing"


@dataclass(frozen=True, kw_only=True)
class PoseEstimate(Estimate):
    """Pose of the camera in the target's frame.

    pose : current pose (m, m, rad).
    covariance : (3, 3), of the pose; infinite while it is unknown.
    initial : pose from which the initial view was taken. It may still be refined during a run,
        and a path planned from it moves with it.
    need : what is missing before the pose means anything.
    """

    pose: Pose
    covariance: Array
    initial: Pose
    need: Need = Need.NOTHING

    @property
    def known(self) -> bool:
        """Whether the pose may be used."""
        return self.need is Need.NOTHING

    @property
    def position_sd(self) -> float:
        """Standard deviation of the position where it is largest (m)."""
        xx, xy, yy = self.covariance[0, 0], self.covariance[0, 1], self.covariance[1, 1]
        return math.sqrt(0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy))

    def values(self) -> dict[str, float]:
        """Return the pose and its standard deviations as numbers for ``ticks.csv``."""
        x_sd, y_sd, phi_sd = np.sqrt(np.diag(self.covariance)).tolist()
        return {**self.pose._asdict(), "x_sd": x_sd, "y_sd": y_sd, "phi_sd": phi_sd}

    @classmethod
    def unknown(cls, need: Need, health: Health, reason: str) -> PoseEstimate:
        """Return the estimate of an estimator that does not know where it is yet."""
        nowhere = Pose(0.0, 0.0, 0.0)
        return cls(
            health=health,
            reason=reason,
            pose=nowhere,
            covariance=np.full((3, 3), np.inf),
            initial=nowhere,
            need=need,
        )
