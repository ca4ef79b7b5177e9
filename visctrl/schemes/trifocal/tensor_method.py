"""What the ways of measuring the tensor have in common."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from visctrl.contracts import Context, Health, Views
from visctrl.hal.types import Velocity
from visctrl.robots.documents import StrictModel

Array = NDArray[np.float64]


class TensorOptions(StrictModel):
    """Options of `Tensor`.

    method : ``constrained`` takes φ1 and the target's direction once from the planar essential
        matrix and fits only the current pose; ``refined`` minimises bearing residuals over all
        calibrated tensors; ``linear5`` and ``linear7`` are the published linear solutions with
        and without the calibration constraints.
    elevations : use how high features are seen to find the initial view at once, before the
        robot moves. Without it (or where features are level with the camera) bearings find it
        after some of the way; they do not need ξ or the focal length.
    phi_1 : where the law's φ1 comes from: the initial and target views, 0, or ``phi_1_deg``. What
        is told counts as known where the views bear it out, and as an assumption where not.
    scale : metric value of T121 from what the robot was told to drive, or ``scale_m``.
    scale_m : the value while nothing better is known (``odometry``) or for good (``given``).
    min_features : fewer than this are no view.
    threshold_sigmas : residual beyond which a feature counts as an outlier.
    hypotheses : random samples when a solution is searched from scratch.
    min_inliers : share of the features that must agree.
    """

    method: Literal["constrained", "refined", "linear5", "linear7"] = "constrained"
    elevations: bool = True
    phi_1: Literal["estimated", "zero", "given"] = "estimated"
    phi_1_deg: Annotated[float, Field(ge=-180.0, le=180.0)] = 0.0
    scale: Literal["odometry", "given"] = "odometry"
    scale_m: Annotated[float, Field(gt=0.0)] = 5.0
    min_features: Annotated[int, Field(ge=5)] = 8
    threshold_sigmas: Annotated[float, Field(gt=0.0)] = 4.0
    hypotheses: Annotated[int, Field(ge=10, le=10_000)] = 300
    min_inliers: Annotated[float, Field(gt=0.0, le=1.0)] = 0.4


class Measurement(NamedTuple):
    """One tick's tensor, in any scale.

    tensor, covariance : (8,), (8, 8).
    phi_1, phi_1_sd : heading of the initial view and its standard deviation (rad).
    scale_m, scale_sd_m : metric value of the tensor's T121, nan and infinite if unknown.
    inliers : features that agree.
    spread : robust standard deviation of the residuals (rad).
    """

    health: Health
    reason: str
    tensor: Array
    covariance: Array
    phi_1: float = 0.0
    phi_1_sd: float = math.inf
    scale_m: float = math.nan
    scale_sd_m: float = math.inf
    inliers: int = 0
    spread: float = 0.0

    @classmethod
    def none(cls, health: Health, reason: str) -> Measurement:
        """Return the measurement of a tick that has none."""
        return cls(health, reason, np.full(8, np.nan), np.full((8, 8), np.nan))


class TensorMethod(ABC):
    """A way of measuring the tensor, followed from tick to tick since one initial view."""

    def __init__(self, options: TensorOptions, context: Context) -> None:
        self.options = options
        self.context = context

    @abstractmethod
    def predict(self, sent: Velocity, dt: float) -> None:
        """Take note of what the robot was told to drive during the last ``dt`` seconds."""

    @abstractmethod
    def measure(self, views: Views) -> Measurement:
        """Return the tensor of the views; health says whether there is one."""
