"""Do the tracks fit one planar motion? A map from two views, and the third view resected in it.

The target and initial views fix each feature's inverse distance, in units of their baseline.
The current view must then fit a pose of three numbers. What does not fit is a wrong match, a
slipped track or a thing that moves; and the fitted pose says where a feature that was lost
should be seen again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.planar import PlanarMotion

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

# Elevations suffer from tilts of the robot that the planar model does not know.
_TANGENT_SLACK = 2.0
# Inverse distances tried, in units of the inverse baseline, before the refinement.
_INVERSE_DISTANCES = np.r_[0.0, np.geomspace(0.02, 12.0, 40)]
# Nothing is known beforehand but that most features are no nearer than a third of the baseline.
_PRIOR_INVERSE_DISTANCE_SD = 3.0
_GATE_SIGMAS = 4.0
_OUTLIER_SCALE = 2.0
# Gauss–Newton steps at most, and the step (baselines, rad) under which noise is larger.
_STEPS, _SETTLED = 8, 1e-4


@dataclass(frozen=True)
class Fit:
    """The current view in the map.

    pose : (3,) x, y of the camera (in baselines) and heading (rad), in the target's frame.
    inliers : (M,) whether each feature agrees with the pose.
    residual_sd : robust standard deviation of the bearing residuals (rad).
    """

    pose: Array
    inliers: Mask
    residual_sd: float

    @property
    def share(self) -> float:
        """Share of the features that agree."""
        return float(self.inliers.mean()) if len(self.inliers) else 0.0


class ThreeViewMap:
    """Features of the target view with the inverse distances that the initial view gives.

    Parameters
    ----------
    target, initial : (N, 3) unit rays (right, forward, up)
    motion : PlanarMotion
        Of the initial view in the target view.
    sigma : float
        Standard deviation of a bearing (rad).
    """

    def __init__(self, target: Array, initial: Array, motion: PlanarMotion, sigma: float) -> None:
        level = np.hypot(target[:, 0], target[:, 1])
        self._bearing = target[:, :2] / level[:, None]
        self._tangent = target[:, 2] / level
        self.initial_pose = np.array(
            [np.sin(motion.direction), np.cos(motion.direction), motion.phi]
        )
        self._inverse, self._variance = self._triangulate(initial, sigma)

    def __len__(self) -> int:
        return len(self._tangent)

    def predict(self, which: Indices, pose: Array) -> tuple[Array, Array]:
        """Return the rays (M, 3) at which features are seen from a pose, and their scale (M,).

        The scale is that of a small patch of the target view, 2 at half the distance.
        """
        q = self._level(pose, self._inverse[which], which)
        norm = np.linalg.norm(q, axis=-1)
        rays = np.concatenate([q, self._tangent[which, None]], axis=-1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True), 1.0 / norm

    def fit(self, which: Indices, rays: Array, start: Array, sigma: float) -> Fit:
        """Resect the view in which features (M,) are seen along rays (M, 3).

        Robust Gauss–Newton (Cauchy weights) on bearings and elevations from ``start``.
        """
        pose = np.array(start, dtype=np.float64)
        for _ in range(_STEPS):
            residual, J, variance = self._linearise(which, rays, pose, sigma)
            scaled = residual**2 / variance
            weight = 1.0 / (variance * (1.0 + scaled.sum(axis=1) / _OUTLIER_SCALE**2)[:, None])
            H = np.einsum("nki,nk,nkj->ij", J, weight, J)
            g = np.einsum("nki,nk,nk->i", J, weight, residual)
            # A little damping: with no parallax at all the position is not determined.
            step = np.linalg.solve(H + np.diag([1.0, 1.0, 1e-3]), g)
            step *= min(1.0, 0.4 / max(float(np.abs(step).max()), 1e-12))
            pose += step
            if float(np.abs(step).max()) < _SETTLED:
                break
        residual, _, variance = self._linearise(which, rays, pose, sigma)
        inliers = _within_gate(residual, variance)
        sure = inliers if inliers.any() else np.ones_like(inliers)
        spread = 1.4826 * float(np.median(np.abs(residual[sure, 0]))) if len(which) else 0.0
        return Fit(pose, inliers, spread)

    def agree(self, which: Indices, rays: Array, pose: Array, sigma: float) -> Mask:
        """Return whether features (M,) seen along rays (M, 3) fit a pose."""
        residual, _, variance = self._linearise(which, rays, pose, sigma)
        return _within_gate(residual, variance)

    def locate(self, which: Indices, rays: Array, motion: PlanarMotion, sigma: float) -> Fit:
        """Resect a view of which only the planar motion from the target view is known."""
        direction = np.array([np.sin(motion.direction), np.cos(motion.direction)])
        starts = [
            np.array([*(distance * direction), motion.phi])
            for distance in (0.0, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0)
        ]
        costs = [self._cost(which, rays, start, sigma) for start in starts]
        return self.fit(which, rays, starts[int(np.argmin(costs))], sigma)

    def _cost(self, which: Indices, rays: Array, pose: Array, sigma: float) -> float:
        residual, _, variance = self._linearise(which, rays, pose, sigma)
        return float(np.log1p((residual**2 / variance).sum(axis=1)).sum())

    def _level(self, pose: Array, inverse: Array, which: Indices | slice) -> Array:
        """Return the horizontal part of the features in a view's axes, over their distance.

        ``inverse`` may have leading axes before that of the features.
        """
        c, s = np.cos(pose[2]), np.sin(pose[2])
        offset = self._bearing[which] - inverse[..., None] * pose[:2]
        return np.asarray(offset @ np.array([[c, -s], [s, c]]), dtype=np.float64)

    def _residual(self, q: Array, tangent: Array, rays: Array) -> Array:
        """Return bearing and tangent residuals (..., M, 2): seen minus predicted."""
        cross = rays[:, 0] * q[..., 1] - rays[:, 1] * q[..., 0]
        dot = rays[:, 0] * q[..., 0] + rays[:, 1] * q[..., 1]
        seen = rays[:, 2] / np.hypot(rays[:, 0], rays[:, 1])
        norm = np.maximum(np.linalg.norm(q, axis=-1), 1e-9)
        return np.stack([np.arctan2(cross, dot), seen - tangent / norm], axis=-1)

    def _linearise(
        self, which: Indices, rays: Array, pose: Array, sigma: float
    ) -> tuple[Array, Array, Array]:
        """Return residuals (M, 2), Jacobian (M, 2, 3) of the prediction, and variances (M, 2)."""
        tangent = self._tangent[which]
        q = self._level(pose, self._inverse[which], which)
        residual = self._residual(q, tangent, rays)
        to_measured = _measurement_jacobian(q, tangent)
        c, s = np.cos(pose[2]), np.sin(pose[2])
        to_axes = np.array([[c, s], [-s, c]])
        by_position = -self._inverse[which, None, None] * (to_measured @ to_axes)
        by_heading = to_measured @ np.stack([q[:, 1], -q[:, 0]], axis=-1)[..., None]
        by_inverse = to_measured @ -(to_axes @ pose[:2])
        variance = sigma**2 * np.array([1.0, _TANGENT_SLACK**2])
        variance = variance + by_inverse**2 * self._variance[which, None]
        return residual, np.concatenate([by_position, by_heading], axis=-1), variance

    def _triangulate(self, initial: Array, sigma: float) -> tuple[Array, Array]:
        """Return inverse distances (N,) from the initial view, and their variances."""
        pose = self.initial_pose
        # Both views have noise, and each residual is a difference of the two.
        variance = 2.0 * sigma**2 * np.array([1.0, _TANGENT_SLACK**2])
        every = slice(None)
        candidates = np.repeat(_INVERSE_DISTANCES[:, None], len(self), axis=1)
        q = self._level(pose, candidates, every)
        cost = (self._residual(q, self._tangent, initial) ** 2 / variance).sum(axis=-1)
        inverse = _INVERSE_DISTANCES[np.argmin(cost, axis=0)]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        step_axes = -(np.array([[c, s], [-s, c]]) @ pose[:2])
        information = np.ones(len(self))
        for _ in range(5):
            q = self._level(pose, inverse, every)
            residual = self._residual(q, self._tangent, initial)
            J = _measurement_jacobian(q, self._tangent) @ step_axes
            information = (J**2 / variance).sum(axis=-1) + _PRIOR_INVERSE_DISTANCE_SD**-2
            inverse = np.maximum(inverse + (J * residual / variance).sum(axis=-1) / information, 0)
        return inverse, 1.0 / information


def _within_gate(residual: Array, variance: Array) -> Mask:
    return np.asarray((residual**2 / variance < _GATE_SIGMAS**2).all(axis=1))


def _measurement_jacobian(q: Array, tangent: Array) -> Array:
    """Return ∂(bearing, tangent of elevation)/∂q (N, 2, 2) of q (N, 2) = (right, forward)."""
    square = np.maximum((q**2).sum(axis=-1), 1e-12)
    bearing = np.stack([q[:, 1], -q[:, 0]], axis=-1) / square[:, None]
    elevation = -(tangent / square**1.5)[:, None] * q
    return np.stack([bearing, elevation], axis=1)
