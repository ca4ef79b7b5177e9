"""Do the tracks fit one planar motion? A map from two views, and the third view resected in it.

The target and initial views fix each feature's inverse distance, in units of their baseline.
The current view must then fit a pose of three numbers. What does not fit is a wrong match, a
slipped track or a thing that moves; and the fitted pose says where a feature that was lost
should be seen again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.robust.least_squares import Options, Solved, gauss_newton
from visctrl.geometry.robust.losses import cauchy
from visctrl.geometry.robust.scale import upper_mad_sd
from visctrl.geometry.two_view.planar import PlanarMotion

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

# Variances of a bearing and of the tangent of an elevation, in those of a bearing: elevations
# suffer from tilts of the robot that the planar model does not know.
_VARIANCES = np.array([1.0, 2.0**2])
# Inverse distances tried, in units of the inverse baseline, before the refinement.
_INVERSE_DISTANCES = np.r_[0.0, np.geomspace(0.02, 12.0, 40)]
# Nothing is known beforehand but that most features are no nearer than a third of the baseline.
_PRIOR_INVERSE_DISTANCE_SD = 3.0
_GATE_SIGMAS = 4.0
_OUTLIER_SCALE = 2.0
# Gauss–Newton steps at most, and the step (baselines, rad) after which the next is a tenth of it
# or less, and noise larger.
_STEPS, _SETTLED = 8, 5e-4
_LONGEST = 0.4
# Gauss–Newton steps of each inverse distance: from the nearest of those tried they converge.
_RANGING_STEPS = 5
# A little damping: with no parallax at all the position is not determined.
_DAMPING = np.diag([1.0, 1.0, 1e-3])


@dataclass(frozen=True)
class Resection:
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
        c, s = np.cos(pose[2]), np.sin(pose[2])
        offset = self._offset(pose, self._inverse[which], which)
        level = offset @ np.array([[c, -s], [s, c]])
        rays = np.concatenate([level, self._tangent[which, None]], axis=-1)
        scale = 1.0 / np.linalg.norm(offset, axis=-1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True), scale

    def fit(self, which: Indices, rays: Array, start: Array, sigma: float) -> Resection:
        """Resect the view in which features (M,) are seen along rays (M, 3).

        Robust Gauss–Newton (Cauchy weights) on bearings and elevations from ``start``.
        """
        seen = _seen(rays)
        pose, (residual, J, variance), step, _ = gauss_newton(
            lambda pose: self._linearise(which, seen, pose, sigma),
            _solve,
            lambda pose, step: np.asarray(pose + step),
            np.array(start, dtype=np.float64),
            Options(_STEPS, converged=_SETTLED**2, longest=_LONGEST),
        )
        # To first order, what is left at the pose as it is now.
        residual = residual - J @ step
        inliers = _within_gate(residual, variance)
        sure = inliers if inliers.any() else np.ones_like(inliers)
        spread = upper_mad_sd(residual[sure, 0]) if len(which) else 0.0
        return Resection(pose, inliers, spread)

    def agree(self, which: Indices, rays: Array, pose: Array, sigma: float) -> Mask:
        """Return whether features (M,) seen along rays (M, 3) fit a pose."""
        residual, _, variance = self._linearise(which, _seen(rays), pose, sigma)
        return _within_gate(residual, variance)

    def locate(self, which: Indices, rays: Array, motion: PlanarMotion, sigma: float) -> Resection:
        """Resect a view of which only the planar motion from the target view is known."""
        direction = np.array([np.sin(motion.direction), np.cos(motion.direction)])
        starts = [
            np.array([*(distance * direction), motion.phi])
            for distance in (0.0, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0)
        ]
        costs = [self._cost(which, rays, start, sigma) for start in starts]
        return self.fit(which, rays, starts[int(np.argmin(costs))], sigma)

    def _cost(self, which: Indices, rays: Array, pose: Array, sigma: float) -> float:
        residual, _, variance = self._linearise(which, _seen(rays), pose, sigma)
        return float(np.log1p((residual**2 / variance).sum(axis=1)).sum())

    def _offset(self, pose: Array, inverse: Array, which: Indices | slice) -> Array:
        """Return the horizontal vectors (..., M, 2) from a view to features, over their distance.

        In the target view's axes. ``inverse`` may have leading axes before that of the features.
        """
        return np.asarray(self._bearing[which] - inverse[..., None] * pose[:2], dtype=np.float64)

    def _linearise(
        self, which: Indices, seen: Array, pose: Array, sigma: float
    ) -> tuple[Array, Array, Array]:
        """Return residuals (M, 2), Jacobian (M, 2, 3) of the prediction, and variances (M, 2)."""
        tangent, inverse = self._tangent[which], self._inverse[which]
        offset = self._offset(pose, inverse, which)
        by_offset = _by_offset(offset, tangent)
        J = np.zeros((len(which), 2, 3))
        J[:, :, :2] = -inverse[:, None, None] * by_offset
        J[:, 0, 2] = 1.0
        variance = sigma**2 * _VARIANCES + (by_offset @ pose[:2]) ** 2 * self._variance[which, None]
        return _residual(offset, tangent, seen, pose[2]), J, variance

    def _triangulate(self, initial: Array, sigma: float) -> tuple[Array, Array]:
        """Return inverse distances (N,) from the initial view, and their variances."""
        pose, tangent, every = self.initial_pose, self._tangent, slice(None)
        seen = _seen(initial)
        # Both views have noise, and each residual is a difference of the two.
        variance = 2.0 * sigma**2 * _VARIANCES
        candidates = np.repeat(_INVERSE_DISTANCES[:, None], len(self), axis=1)
        residual = _residual(self._offset(pose, candidates, every), tangent, seen, pose[2])
        cost = (residual**2 / variance).sum(axis=-1)

        def linearise(inverse: Array) -> tuple[Array, Array]:
            offset = self._offset(pose, inverse, every)
            residual = _residual(offset, tangent, seen, pose[2])
            J = -_by_offset(offset, tangent) @ pose[:2]
            information = (J**2 / variance).sum(axis=-1) + _PRIOR_INVERSE_DISTANCE_SD**-2
            return (J * residual / variance).sum(axis=-1), information

        inverse, (_, information), _, _ = gauss_newton(
            linearise,
            lambda at: Solved(at[0] / at[1], math.inf),
            lambda inverse, step: np.maximum(inverse + step, 0.0),
            _INVERSE_DISTANCES[np.argmin(cost, axis=0)],
            Options(_RANGING_STEPS),
        )
        return inverse, 1.0 / information


def _solve(at: tuple[Array, Array, Array]) -> Solved[Array]:
    """Return the step of a pose, with Cauchy's loss of both residuals of a feature together."""
    residual, J, variance = at
    square = (residual**2 / variance).sum(axis=1)
    weight = cauchy(square / _OUTLIER_SCALE**2)[:, None] / variance
    weighted = (weight[..., None] * J).reshape(-1, 3).T
    H, g = weighted @ J.reshape(-1, 3), weighted @ residual.ravel()
    step = np.asarray(np.linalg.solve(H + _DAMPING, g), dtype=np.float64)
    longest = float(np.abs(step).max())
    return Solved(step, longest**2, longest)


def _within_gate(residual: Array, variance: Array) -> Mask:
    return np.asarray((residual**2 / variance < _GATE_SIGMAS**2).all(axis=1))


def _seen(rays: Array) -> Array:
    """Return the bearings and tangents of elevation (M, 2) of rays (M, 3)."""
    right, forward, up = rays.T
    return np.stack([np.arctan2(right, forward), up / np.hypot(right, forward)], axis=-1)


def _residual(offset: Array, tangent: Array, seen: Array, phi: float) -> Array:
    """Return bearing and tangent residuals (..., M, 2): seen minus predicted."""
    right, forward = offset[..., 0], offset[..., 1]
    residual = np.empty(offset.shape)
    turn = seen[:, 0] - phi - np.arctan2(right, forward)
    residual[..., 0] = turn - 2.0 * np.pi * np.rint(turn / (2.0 * np.pi))
    residual[..., 1] = seen[:, 1] - tangent / np.maximum(np.hypot(right, forward), 1e-9)
    return residual


def _by_offset(offset: Array, tangent: Array) -> Array:
    """Return ∂(bearing, tangent of elevation)/∂offset (N, 2, 2) of offsets (N, 2)."""
    square = np.maximum((offset**2).sum(axis=-1), 1e-12)
    J = np.empty((len(offset), 2, 2))
    J[:, 0, 0], J[:, 0, 1] = offset[:, 1] / square, -offset[:, 0] / square
    J[:, 1] = -(tangent / (square * np.sqrt(square)))[:, None] * offset
    return J
