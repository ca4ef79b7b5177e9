"""Estimator ``planar-motion``: the target's bearing and heading from the current view alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from visctrl.contracts import Context, Estimator, Health, Signal, Views
from visctrl.geometry.two_view.degeneracy import Degeneracy
from visctrl.geometry.two_view.planar import (
    PlanarMotion,
    ransac_planar_motion,
    refine_planar_motion,
    sampson_residuals,
)
from visctrl.hal.types import Velocity
from visctrl.robots.documents import StrictModel
from visctrl.schemes.trifocal.estimate import PlanarMotionEstimate


class PlanarMotionOptions(StrictModel):
    """Options of `PlanarMotionEstimator`.

    threshold_sigmas : residual beyond which a feature counts as an outlier.
    hypotheses : random samples when the motion is searched from scratch.
    min_inliers : share of the features that must agree; else the motion is searched anew.
    """

    threshold_sigmas: Annotated[float, Field(gt=0.0)] = 4.0
    hypotheses: Annotated[int, Field(ge=10, le=10_000)] = 300
    min_inliers: Annotated[float, Field(gt=0.0, le=1.0)] = 0.6


class PlanarMotionEstimator(Estimator[PlanarMotionOptions, PlanarMotionEstimate]):
    """Planar essential matrix of the current and target views, followed from frame to frame."""

    Options: ClassVar[type[PlanarMotionOptions]] = PlanarMotionOptions
    signals: ClassVar[tuple[Signal, ...]] = (
        Signal("bearing", "rad"),
        Signal("bearing_sd", "rad"),
        Signal("target_heading", "rad"),
        Signal("inliers", "1"),
    )

    def __init__(self, options: PlanarMotionOptions, context: Context) -> None:
        super().__init__(options, context)
        self._motion: PlanarMotion | None = None

    def reset(self) -> None:
        """Forget the last motion: the next one is searched from scratch."""
        self._motion = None

    def update(self, views: Views, sent: Velocity, dt: float) -> PlanarMotionEstimate:
        """Return the motion from the current view to the target's."""
        if views.health is Health.LOST:
            return self._lost(views)
        motion = self._follow(views, sent.omega * dt) or self._search(views)
        self._motion = motion if motion.found else None
        unknown = Health.DEGENERATE if motion.found else Health.LOST
        health = Health.OK if motion.determined else unknown
        return PlanarMotionEstimate(health=health, reason=motion.reason, motion=motion)

    def values(self) -> Mapping[str, float]:
        """Return bearing and heading of the target, and how many features agree."""
        if self._motion is None:
            return {}
        return {
            "bearing": self._motion.direction,
            "bearing_sd": self._motion.direction_sd,
            "target_heading": self._motion.phi,
            "inliers": float(self._motion.inliers.sum()),
        }

    def _follow(self, views: Views, turn: float) -> PlanarMotion | None:
        """Return the last motion refined on this frame, or None where that is not sound.

        ``turn`` is how far the robot was told to turn since (rad).
        """
        if self._motion is None:
            return None
        start = (self._motion.phi - turn, self._motion.direction + turn)
        residual, _ = sampson_residuals(views.current, views.target, *start)
        # Twice the threshold: the prediction has errors of its own.
        near = np.abs(residual) < 2.0 * self.options.threshold_sigmas * views.sigma
        if not near.size or near.mean() < self.options.min_inliers:
            return None
        motion = refine_planar_motion(views.current[near], views.target[near], *start, views.sigma)
        if not motion.found:
            return None
        inliers = near.copy()
        inliers[near] = motion.inliers
        return replace(motion, inliers=inliers)

    def _search(self, views: Views) -> PlanarMotion:
        return ransac_planar_motion(
            views.current,
            views.target,
            views.sigma,
            seed=self.context.seed,
            threshold_sigmas=self.options.threshold_sigmas,
            hypotheses=self.options.hypotheses,
        )

    def _lost(self, views: Views) -> PlanarMotionEstimate:
        nothing = PlanarMotion(
            phi=0.0,
            direction=0.0,
            covariance=np.diag([np.inf, np.inf]),
            inliers=np.zeros(len(views), dtype=np.bool_),
            degeneracy=Degeneracy.TOO_FEW,
        )
        self._motion = None
        return PlanarMotionEstimate(health=Health.LOST, reason=views.reason, motion=nothing)
