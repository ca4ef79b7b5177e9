"""Tensor without knowledge of the initial view: the published linear ways, and a refined one."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Context, Health, Views
from visctrl.geometry.robust.scale import mad_sd
from visctrl.geometry.trifocal.fit import debiased_covariance, refine
from visctrl.geometry.trifocal.solvers import (
    identical_views,
    linear_covariance,
    ransac_tensor,
    solve_linear,
)
from visctrl.geometry.trifocal.tensor import (
    CALIBRATED,
    T112,
    T121,
    UNCALIBRATED,
    Trilinear,
    normalised,
    normalised_covariance,
    sampson_residuals,
    trilinear,
)
from visctrl.geometry.two_view.planar import ransac_planar_motion
from visctrl.hal.types import Velocity
from visctrl.schemes.path_scale import DeadReckoning, PathScale
from visctrl.schemes.trifocal.initial_view import InitialView
from visctrl.schemes.trifocal.tensor_method import Measurement, TensorMethod, TensorOptions

Array = NDArray[np.float64]

#: The leg counts as straight while the robot has turned less than this (rad).
_STRAIGHT = math.radians(3.0)


class LinearFit(TensorMethod):
    """Five- or seven-point tensor of the features that a RANSAC over minimal samples keeps.

    T121 gets its metric value on the first, straight leg, along which ξ1 falls by cos φ1/T121
    for every metre, and keeps it: its change on the way is what the law has to bear.
    """

    def __init__(self, options: TensorOptions, context: Context) -> None:
        super().__init__(options, context)
        self._basis = UNCALIBRATED if options.method == "linear7" else CALIBRATED
        self._phi_1: tuple[float, float] | None = None
        self._reckoning = DeadReckoning(context.limits, context.camera_forward_m)
        self._scale = PathScale()
        self._driven = 0.0
        self._speed = 0.0
        self._turned = 0.0

    def predict(self, sent: Velocity, dt: float) -> None:
        """Advance the dead-reckoned straight leg."""
        motion = self._reckoning.motion(sent, dt)
        self._driven += float(motion[1])
        self._speed = float(motion[1]) / dt if dt > 0.0 else 0.0
        self._turned += abs(float(motion[2]))

    def measure(self, views: Views) -> Measurement:
        """Return the tensor of the current view."""
        unknowns = self._basis.shape[1]
        if len(views) < unknowns:
            few = f"too few features: {len(views)}, {unknowns} are needed"
            return Measurement.none(Health.LOST, few)
        if self._phi_1 is None:
            self._phi_1 = self._initial_heading(views)
        for name, other in (("current", views.current), ("target", views.target)):
            if identical_views(views.initial, other, views.sigma):
                return Measurement.none(Health.DEGENERATE, f"views identical: initial and {name}")
        return self._solve(views, *self._phi_1)

    def _solve(self, views: Views, phi_1: float, phi_1_sd: float) -> Measurement:
        relation = trilinear(views.initial, views.current, views.target).within(self._basis)
        _, inliers = ransac_tensor(
            relation,
            views.sigma,
            seed=self.context.seed,
            threshold_sigmas=self.options.threshold_sigmas,
            hypotheses=self.options.hypotheses,
        )
        unknowns = self._basis.shape[1]
        if inliers.sum() < unknowns or inliers.mean() < self.options.min_inliers:
            share = f"{int(inliers.sum())} of {len(views)} features agree on a tensor"
            return Measurement.none(Health.DEGENERATE, f"features disagree: {share}")
        agreeing = relation.take(inliers)
        z, covariance = self._estimate(agreeing, views.sigma)
        tensor = self._basis @ z
        if abs(tensor[T121]) < 1e-6:
            return Measurement.none(Health.DEGENERATE, "T121 vanishes: no tensor of such a task")
        spread = mad_sd(sampson_residuals(agreeing, z))
        covariance = self._basis @ covariance @ self._basis.T
        scale, scale_sd = self._follow(tensor, covariance, phi_1)
        return Measurement(
            Health.OK,
            "",
            tensor,
            covariance,
            phi_1=phi_1,
            phi_1_sd=phi_1_sd,
            scale_m=scale,
            scale_sd_m=scale_sd,
            inliers=int(inliers.sum()),
            spread=spread,
        )

    def _estimate(self, relation: Trilinear, sigma: float) -> tuple[Array, Array]:
        z = solve_linear(relation)
        if self.options.method == "refined":
            fit = refine(relation, z, sigma)
            return fit.z, debiased_covariance(relation, fit, sigma)
        return z, linear_covariance(relation, z, sigma)

    def _initial_heading(self, views: Views) -> tuple[float, float]:
        """Return φ1 and its sd (rad) from initial and target view, 0 where they do not tell."""
        if self.options.phi_1 == "zero":
            return 0.0, math.inf
        motion = ransac_planar_motion(
            views.initial, views.target, views.sigma, seed=self.context.seed
        )
        known = math.isfinite(motion.phi_sd)
        return (InitialView.of(motion).phi, motion.phi_sd) if known else (0.0, math.inf)

    def _follow(self, tensor: Array, covariance: Array, phi_1: float) -> tuple[float, float]:
        """Compare the paths seen and driven on the straight leg; return T121 in metres."""
        if self._turned < _STRAIGHT:
            T = normalised(tensor)
            spread = normalised_covariance(tensor, covariance)
            # ξ1 = 1 where the leg began; its variance is T112's, T121 being 1.
            seen = (1.0 - T[T112] - T[T121]) / math.cos(phi_1)
            self._scale.update(
                (0.0, self._driven),
                (0.0, self._speed),
                (0.0, seen),
                math.sqrt(max(float(spread[T112, T112]), 0.0)),
            )
        return self._scale.estimate()
