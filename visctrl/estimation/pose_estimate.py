"""What the pose estimators deliver."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from hal.types import Pose
from visctrl.plugins import Estimate

Array = NDArray[np.float64]


class Need(StrEnum):
    """What an estimator wants the robot to do before its pose can be used."""

    #: Stand, while the initial view is averaged.
    STILL = "still"
    #: Drive straight ahead: the known motion gives the scale.
    FORWARD = "forward"
    #: The pose may be used.
    NOTHING = "nothing"


@dataclass(frozen=True)
class PoseEstimate(Estimate):
    """Pose of the camera in the target's frame.

    pose : current pose (m, m, rad).
    covariance : (3, 3), of the pose.
    initial : pose from which the initial view was taken; the metric of the plane may still be
        refined during a run, and a path planned from here moves with it.
    need : what is missing before the other fields mean anything.
    nis : normalised innovation squared of this tick's measurement, 0 without one.
    nis_dof : its dimension.
    """

    pose: Pose = Pose(0.0, 0.0, 0.0)
    covariance: Array = np.full((3, 3), np.inf)
    initial: Pose = Pose(0.0, 0.0, 0.0)
    need: Need = Need.NOTHING
    nis: float = 0.0
    nis_dof: int = 0
