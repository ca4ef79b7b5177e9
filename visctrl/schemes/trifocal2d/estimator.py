"""Estimator ``tensor2d``: the trifocal tensor of points under planar motion, twelve elements."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from visctrl.contracts import Context, Estimate, Estimator, Health, Signal, Views
from visctrl.geometry.trifocal.solvers import identical_views
from visctrl.geometry.trifocal.tensor2d import (
    ELEMENTS_2D,
    SAMPLE_2D,
    T221,
    T223,
    T232,
    heading_2d,
    incidence,
    normalised_2d,
    ransac_2d,
    solve_2d,
)
from visctrl.geometry.two_view.planar import ransac_planar_motion
from visctrl.hal.types import Velocity
from visctrl.robots.documents import StrictModel
from visctrl.schemes.path_scale import DeadReckoning, PathScale

Array = NDArray[np.float64]

#: The leg counts as straight while the robot has turned less than this (rad).
_STRAIGHT = math.radians(3.0)
#: The leg tells the scale down to this share of the distance: near the target T232, with the
#: baseline's direction, is not determined.
_FAR = 0.5

Positive = Annotated[float, Field(gt=0.0)]


class Tensor2dOptions(StrictModel):
    """Options of `Tensor2d`.

    phi_1 : where φ1 comes from: the initial and target views, 0, or ``phi_1_deg``.
    scale : |t_1| from what the robot was told to drive on the first, straight leg, or ``scale_m``.
    scale_m : the value while nothing better is known (``odometry``) or for good (``given``).
    min_features, min_inliers : least number of features, and share of them that must agree.
    threshold_sigmas : residual beyond which a feature counts as an outlier.
    hypotheses : random samples of four features.
    """

    phi_1: Literal["estimated", "zero", "given"] = "estimated"
    phi_1_deg: Annotated[float, Field(ge=-180.0, le=180.0)] = 0.0
    scale: Literal["odometry", "given"] = "odometry"
    scale_m: Positive = 5.0
    min_features: Annotated[int, Field(ge=SAMPLE_2D + 1)] = 8
    min_inliers: Annotated[float, Field(gt=0.0, le=1.0)] = 0.4
    threshold_sigmas: Positive = 4.0
    hypotheses: Annotated[int, Field(ge=10, le=10_000)] = 60


@dataclass(frozen=True, kw_only=True)
class Tensor2dEstimate(Estimate):
    """The tensor (1.9) in units of |t_1|, the initial distance to the target.

    elements, covariance : (12,), (12, 12), in the order of `ELEMENTS_2D`.
    phi_1 : heading of the initial view in the target's frame (rad).
    scale_m, scale_sd_m : |t_1| in metres; the latter infinite while it is a mere guess.
    """

    elements: Array
    covariance: Array
    phi_1: float
    scale_m: float
    scale_sd_m: float

    @property
    def target(self) -> Array:
        """The target's position (right, forward) from the current pose, in units of |t_1|."""
        return np.asarray(self.elements[[T221, T223]])

    @property
    def heading(self) -> float:
        """Heading of the current view in the target's frame (rad)."""
        return heading_2d(self.elements, self.phi_1)


class Tensor2d(Estimator[Tensor2dOptions, Tensor2dEstimate]):
    """Linear solution, weighted by its noise, on what a RANSAC over four features keeps.

    It uses elevations throughout, so it needs a calibrated camera, which the 1D tensor does not.
    """

    Options: ClassVar[type[Tensor2dOptions]] = Tensor2dOptions
    signals: ClassVar[tuple[Signal, ...]] = (
        *(Signal(name, "1") for name in ELEMENTS_2D),
        Signal("heading", "rad"),
        Signal("scale", "m"),
        Signal("inliers", "1"),
    )

    def __init__(self, options: Tensor2dOptions, context: Context) -> None:
        super().__init__(options, context)
        self.reset()

    def reset(self) -> None:
        """Forget everything: a new initial view has been taken here."""
        start = np.zeros(12)
        start[T232] = -1.0
        self._last = Tensor2dEstimate(
            health=Health.LOST,
            elements=start,
            covariance=np.eye(12),
            phi_1=0.0,
            scale_m=self.options.scale_m,
            scale_sd_m=math.inf,
        )
        self._phi_1: float | None = None
        self._reckoning = DeadReckoning(self.context.limits, self.context.camera_forward_m)
        self._path = PathScale()
        self._driven, self._speed, self._turned = 0.0, 0.0, 0.0
        self._inliers = 0

    def update(self, views: Views, sent: Velocity, dt: float) -> Tensor2dEstimate:
        """Return the tensor of the three views (see the contract)."""
        motion = self._reckoning.motion(sent, dt)
        self._driven += float(motion[1])
        self._speed = float(motion[1]) / dt if dt > 0.0 else 0.0
        self._turned += abs(float(motion[2]))
        self._inliers = 0
        if views.health is Health.LOST or len(views) < self.options.min_features:
            few = f"too few features: {len(views)}, {self.options.min_features} are needed"
            return replace(self._last, health=Health.LOST, reason=views.reason or few)
        if identical_views(views.initial, views.target, views.sigma):
            reason = "views identical: initial and target, so there is no unit of length"
            return replace(self._last, health=Health.DEGENERATE, reason=reason)
        return self._measured(views)

    def values(self) -> Mapping[str, float]:
        """Return every element, the heading and the scale."""
        if self._inliers == 0:
            return {}
        numbers = dict(zip(ELEMENTS_2D, self._last.elements.tolist(), strict=True))
        numbers["heading"] = self._last.heading
        numbers["scale"] = self._last.scale_m
        return {**numbers, "inliers": float(self._inliers)}

    def _measured(self, views: Views) -> Tensor2dEstimate:
        options = self.options
        relation = incidence(views.initial, views.current, views.target)
        agreeing = ransac_2d(
            relation,
            views.sigma,
            seed=self.context.seed,
            threshold_sigmas=options.threshold_sigmas,
            hypotheses=options.hypotheses,
        )
        if agreeing.sum() <= SAMPLE_2D or agreeing.mean() < options.min_inliers:
            share = f"{int(agreeing.sum())} of {len(views)} features agree on a tensor"
            reason = f"features disagree: {share}"
            return replace(self._last, health=Health.DEGENERATE, reason=reason)
        if self._phi_1 is None:
            self._phi_1 = self._initial_heading(views)
        tensor, covariance = normalised_2d(*solve_2d(relation.take(agreeing), views.sigma))
        scale, scale_sd = self._scale(tensor, covariance)
        self._inliers = int(agreeing.sum())
        self._last = Tensor2dEstimate(
            health=Health.OK,
            elements=tensor,
            covariance=covariance,
            phi_1=self._phi_1,
            scale_m=scale,
            scale_sd_m=scale_sd,
        )
        return self._last

    def _initial_heading(self, views: Views) -> float:
        """Return φ1 (rad), 0 where the initial and target views do not tell."""
        if self.options.phi_1 == "given":
            return math.radians(self.options.phi_1_deg)
        if self.options.phi_1 == "zero":
            return 0.0
        motion = ransac_planar_motion(
            views.initial, views.target, views.sigma, seed=self.context.seed
        )
        return -motion.phi if math.isfinite(motion.phi_sd) else 0.0

    def _scale(self, tensor: Array, covariance: Array) -> tuple[float, float]:
        """Compare the paths seen and driven on the straight leg; return |t_1| in metres."""
        if self._turned < _STRAIGHT and tensor[T223] > _FAR:
            # On the leg t_y falls from −T232 to T223.
            slope = np.zeros(12)
            slope[[T223, T232]] = -1.0
            self._path.update(
                (0.0, self._driven),
                (0.0, self._speed),
                (0.0, float(-tensor[T232] - tensor[T223])),
                math.sqrt(max(float(slope @ covariance @ slope), 0.0)),
            )
        scale, scale_sd = self._path.estimate()
        if self.options.scale == "given" or not math.isfinite(scale_sd):
            return self.options.scale_m, math.inf
        return scale, scale_sd
