"""Tensor with a known initial view: three unknowns a tick, followed robustly."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Context, Health, Views
from visctrl.geometry.trifocal.fit import (
    Coupling,
    TensorFit,
    coupling,
    refine,
    view_jacobian,
    view_of,
)
from visctrl.geometry.trifocal.solvers import identical_views, ransac_tensor
from visctrl.geometry.trifocal.tensor import (
    T111,
    T112,
    T121,
    T122,
    FixedForms,
    Trilinear,
    unit_bearings,
)
from visctrl.geometry.two_view.degeneracy import Degeneracy
from visctrl.geometry.two_view.planar import PlanarMotion, ransac_planar_motion
from visctrl.hal.types import Pose, Velocity
from visctrl.schemes.path_scale import DeadReckoning, PathScale, Point
from visctrl.schemes.trifocal.initial_view import (
    InitialFromBearings,
    InitialView,
    InitialViewFilter,
)
from visctrl.schemes.trifocal.tensor_method import Measurement, TensorMethod, TensorOptions

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: With a smaller share of agreeing features, a solution is searched from scratch as well.
DOUBTFUL = 0.6
#: Residuals may be spread this many times wider than promised (drift of the tracks).
DRIFT = 3.0
#: Residuals so many times wider than promised make the initial view doubtful; it is then
#: searched anew every so many ticks.
CONTRADICTION, RECONSIDER = 2.5, 10
#: Bearings agree with those of the target within so many times what noise explains.
_SAME_WITHIN = 2.0
#: Mean length of the bearings' unit vectors beyond which they say too little (±17° and less).
_CLUSTERED = 0.985
_NOWHERE = Pose(0.0, 0.0, 0.0)


class ConstrainedFit(TensorMethod):
    """Fits (φ2, t_2) by robust Gauss–Newton; φ1 and the direction of t_1 are found once.

    Lengths are in units of the initial distance to the target, whose metric value comes from
    comparing the path seen with the path driven.
    """

    def __init__(self, options: TensorOptions, context: Context) -> None:
        super().__init__(options, context)
        self._initial: InitialViewFilter | None = None
        self._bearings = InitialFromBearings(options, context.seed)
        self._reckoning = DeadReckoning(context.limits, context.camera_forward_m)
        self._scale = PathScale()
        # Position and heading in the initial view's frame: as driven, and as last seen.
        self._driven = self._velocity = (0.0, 0.0)
        self._turned = 0.0
        self._moved = _NOWHERE
        # Heading of the last view, and where it saw the target.
        self._view: tuple[float, Point] | None = None
        self._doubts = 0
        # What the fixed views contribute to every tick's relation, and which views these were.
        self._fixed: tuple[Views, FixedForms] | None = None

    def predict(self, sent: Velocity, dt: float) -> None:
        """Advance the dead-reckoned path, along the heading that was last seen."""
        x, y, turn = self._reckoning.motion(sent, dt)
        right, forward = _rotated((x, y), self._turned)
        self._driven = (self._driven[0] + right, self._driven[1] + forward)
        self._velocity = (right / dt, forward / dt) if dt > 0.0 else (0.0, 0.0)
        moved = self._moved
        right, forward = _rotated((x, y), moved.phi)
        self._moved = Pose(moved.x + right, moved.y + forward, moved.phi + turn)
        self._turned += turn

    def measure(self, views: Views) -> Measurement:
        """Return the tensor of the current view."""
        if self._initial is None:
            found = self._find_initial(views)
            if isinstance(found, Measurement):
                return found
            self._initial = InitialViewFilter(found)
        relation = self._relation(views)
        fit, agreeing = self._fit(relation, self._initial.view, views.sigma)
        if fit.spread > CONTRADICTION * views.sigma:
            fit, agreeing = self._reconsidered(views, relation, fit, agreeing)
        initial = self._initial.view
        inliers = int(np.count_nonzero(agreeing))
        if inliers < self.options.min_inliers * len(views):
            share = f"{inliers} of {len(views)} features agree on a pose"
            return Measurement.none(Health.DEGENERATE, f"features disagree: {share}")
        heading, target = view_of(fit.z)
        if not math.isfinite(target[0] + target[1]):
            return Measurement.none(Health.DEGENERATE, "features clustered: no pose determined")
        self._follow(initial, heading, target, fit)
        shared = coupling(relation, fit, initial.parameters, initial.jacobian)
        self._initial.update(shared)
        uncertainty = self._initial.view.covariance
        if not math.isfinite(float(uncertainty.trace())):
            return Measurement.none(Health.DEGENERATE, "initial view not determined yet")
        return self._measurement(initial, uncertainty, shared, fit, inliers)

    def _relation(self, views: Views) -> Trilinear:
        """Return the trilinear relation of the three views."""
        known = self._fixed
        if (
            known is None
            or known[0].initial is not views.initial
            or known[0].target is not views.target
        ):
            known = self._fixed = (views, FixedForms(views.initial, views.target))
        return known[1].relation(views.current)

    def _find_initial(self, views: Views) -> InitialView | Measurement:
        """Return the initial view, or why this tick has none (or needs none)."""
        if identical_views(views.initial, views.target, views.sigma):
            return self._turned_only(views)
        reason = "elevations are not used"
        if self.options.elevations:
            motion = self._motion(views.initial, views)
            if motion.determined:
                return InitialView.of(motion)
            reason = motion.reason
            if _on_target(motion, views.initial, views):
                # Bearings would find some motion too, with a baseline made of noise.
                return self._turned_only(views)
        found = self._bearings.find(views, self._driven, self._turned)
        if isinstance(found, InitialView):
            return found
        return Measurement.none(
            Health.DEGENERATE, f"initial and target view: {reason}; {found.reason}"
        )

    def _motion(self, rays: Array, views: Views) -> PlanarMotion:
        """Return the motion from a view with these rays to the target's."""
        return ransac_planar_motion(
            rays,
            views.target,
            views.sigma,
            seed=self.context.seed,
            threshold_sigmas=self.options.threshold_sigmas,
            hypotheses=self.options.hypotheses,
        )

    def _turned_only(self, views: Views) -> Measurement:
        """Return the tensor of a robot that started on the target's position and still is there.

        Then no view has parallax and only headings are known; t_1 is anything, say straight
        ahead, and t_2 = 0.
        """
        motion = self._motion(views.current, views)
        turned_only = _on_target(motion, views.current, views) or identical_views(
            views.current, views.target, views.sigma
        )
        if not motion.found or not turned_only:
            reason = "views identical: initial and target, so no distance can be measured"
            return Measurement.none(Health.DEGENERATE, reason)
        middle = unit_bearings(views.target)[0].mean(axis=0)
        if float(middle @ middle) > _CLUSTERED**2:
            reason = "features clustered: too close together to tell whether this is the target"
            return Measurement.none(Health.DEGENERATE, reason)
        heading = -motion.phi
        tensor = np.zeros(8)
        tensor[[T112, T121]] = -math.cos(heading), math.cos(heading)
        tensor[[T111, T122]] = math.sin(heading)
        slope = np.zeros(8)
        slope[[T112, T121]] = math.sin(heading), -math.sin(heading)
        slope[[T111, T122]] = math.cos(heading)
        return Measurement(
            Health.OK,
            "",
            tensor,
            motion.phi_sd**2 * np.outer(slope, slope),
            inliers=int(motion.inliers.sum()),
            spread=views.sigma,
        )

    def _fit(
        self, relation: Trilinear, initial: InitialView, sigma: float
    ) -> tuple[TensorFit, Mask]:
        """Return the fit that starts from the prediction, or a better one from scratch."""
        relation = relation.within(initial.basis)
        start = self._predicted(initial)
        fit = refine(relation, start, sigma)
        agreeing = self._agreeing(fit, sigma)
        if np.count_nonzero(agreeing) >= DOUBTFUL * len(relation) or len(relation) < 4:
            return fit, agreeing
        z, inliers = ransac_tensor(
            relation,
            sigma,
            seed=self.context.seed,
            threshold_sigmas=self.options.threshold_sigmas,
            hypotheses=self.options.hypotheses,
        )
        # z and −z are one tensor: the robot has not turned half round since the last tick.
        z = z if z[:2] @ start[:2] >= 0.0 else -z
        if inliers.sum() > len(z):
            z = refine(relation.take(inliers), z, sigma).z
        other = refine(relation, z, sigma)
        others = self._agreeing(other, sigma)
        return (other, others) if others.sum() > agreeing.sum() else (fit, agreeing)

    def _reconsidered(
        self, views: Views, relation: Trilinear, fit: TensorFit, agreeing: Mask
    ) -> tuple[TensorFit, Mask]:
        """Return a fit with another initial view if the present one was the wrong solution.

        Residuals far above the noise say that the initial view cannot be right; the bearings
        alone have two solutions, and a poor prior may have led to the false one.
        """
        assert self._initial is not None
        self._doubts += 1
        if self._doubts % RECONSIDER != 1:
            return fit, agreeing
        prior = self._initial.prior
        other = self._bearings.find(views, self._driven, self._turned, prior)
        if not isinstance(other, InitialView):
            return fit, agreeing
        others_fit, others = self._fit(relation, other, views.sigma)
        if others_fit.spread > fit.spread / 2.0 or others.sum() < agreeing.sum():
            return fit, agreeing
        self._initial = InitialViewFilter(other)
        return others_fit, others

    def _agreeing(self, fit: TensorFit, sigma: float) -> Mask:
        limit = self.options.threshold_sigmas * min(fit.spread, DRIFT * sigma)
        return np.asarray(np.abs(fit.residuals) < limit)

    def _predicted(self, initial: InitialView) -> Array:
        """Return the view coordinates (4,), of unit length, that the driven motion leads to."""
        heading, (right, forward) = self._view or (initial.phi, initial.target)
        scale, _ = self._scale.estimate()
        unit = 0.0 if math.isnan(scale) else 1.0 / scale
        dx, dy, turn = self._moved
        x, y = _rotated((right - dx * unit, forward - dy * unit), -turn)
        inverse = 1.0 / math.sqrt(1.0 + x * x + y * y)
        c, s = inverse * math.cos(heading + turn), inverse * math.sin(heading + turn)
        return np.array([c, s, inverse * x, inverse * y])

    def _follow(self, initial: InitialView, heading: float, target: Point, fit: TensorFit) -> None:
        """Keep the pose for the next prediction, and compare the paths seen and driven."""
        self._view = (heading, target)
        self._moved = _NOWHERE
        self._turned = heading - initial.phi
        right, forward = _rotated(target, self._turned)
        seen = (initial.target[0] - right, initial.target[1] - forward)
        J = view_jacobian(fit.z)[1:]
        seen_sd = math.sqrt(float(np.vdot(J.dot(fit.covariance), J)) / 2.0)
        self._scale.update(self._driven, self._velocity, seen, seen_sd)

    def _measurement(
        self,
        initial: InitialView,
        uncertainty: Array,
        known: Coupling,
        fit: TensorFit,
        inliers: int,
    ) -> Measurement:
        basis = initial.basis
        tensor = basis.dot(fit.z)
        by_initial = basis.dot(known.sensitivity) + known.by_initial
        covariance = basis.dot(fit.covariance).dot(basis.T)
        covariance += by_initial.dot(uncertainty).dot(by_initial.T)
        # In units of the initial distance the target's heading has unit length in z.
        unit = float(tensor[T121]) / math.hypot(*fit.z[:2].tolist())
        distance, distance_sd = self._scale.estimate()
        return Measurement(
            Health.OK,
            "",
            tensor,
            covariance,
            phi_1=initial.phi,
            phi_1_sd=math.sqrt(float(uncertainty[0, 0])),
            scale_m=distance * unit,
            scale_sd_m=distance_sd * abs(unit),
            inliers=inliers,
            spread=fit.spread,
        )


def _on_target(motion: PlanarMotion, rays: Array, views: Views) -> bool:
    """Return whether neither elevations nor, less sharply, bearings tell a view from the target.

    Elevations alone say so too where all features are level with the camera.
    """
    return motion.degeneracy is Degeneracy.IDENTICAL and identical_views(
        rays, views.target, _SAME_WITHIN * views.sigma
    )


def _rotated(vector: Point, angle: float) -> Point:
    """Return a vector of a frame turned by ``angle`` (rad) in the unturned frame."""
    s, c = math.sin(angle), math.cos(angle)
    return c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]
