"""Planar motion between two views of unit rays: its essential matrix, found robustly.

View A is the reference. Rays are (right, forward, up) in each view's own axes. View B has the
heading φ (counter-clockwise) and its centre is seen from A at the bearing θ (clockwise from
forward), so that for a point seen along a and b

    aᵀ E b = 0,   E = [0 0 cos θ; 0 0 −sin θ; −cos α  sin α  0],   α = θ + φ.

α is the bearing of the baseline in B's axes. E knows θ up to π (the sign comes from points
lying in front of both views). It uses elevations, so it needs a calibrated camera; features at
the camera's own height say nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from visctrl.geometry.robust.sampling import distinct_samples, ransac
from visctrl.geometry.two_view.degeneracy import Degeneracy
from visctrl.geometry.two_view.parallax import signed_parallax
from visctrl.geometry.two_view.planar_2pt import two_point_motions
from visctrl.geometry.two_view.planar_fit import MotionFit, RayPairs, fit
from visctrl.robots.unicycle import wrap_angle

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Fewer correspondences than this leave no residual to judge a motion by.
MINIMUM_FEATURES = 4
#: A feature's parallax is at most this many times the usual one.
NEAREST = 10.0


@dataclass(frozen=True)
class PlanarMotion:
    """Pose of view B in view A up to the length of the baseline.

    phi : heading of B in A's frame (rad, counter-clockwise).
    direction : bearing in A of B's centre (rad, clockwise from forward, in (−π, π]).
    covariance : (2, 2), of (phi, direction) (rad²); infinite where nothing was measured.
    inliers : (N,) features that agree with the motion.
    degeneracy : what is not determined, if anything; with identical views ``phi`` is still valid
        and only ``direction`` is not.
    detail : more about it, for a reader.
    """

    phi: float
    direction: float
    covariance: Array
    inliers: Mask
    degeneracy: Degeneracy | None = None
    detail: str = ""

    @property
    def found(self) -> bool:
        """Whether there is a motion, if one that is not determined in all."""
        return self.degeneracy is None or self.degeneracy.found

    @property
    def determined(self) -> bool:
        """Whether all of the motion is known."""
        return self.degeneracy is None

    @property
    def reason(self) -> str:
        """What is not determined, for a reader; empty if nothing."""
        if self.degeneracy is None:
            return ""
        return f"{self.degeneracy}: {self.detail}" if self.detail else str(self.degeneracy)

    @property
    def phi_sd(self) -> float:
        """Standard deviation of ``phi`` (rad)."""
        return math.sqrt(float(self.covariance[0, 0]))

    @property
    def direction_sd(self) -> float:
        """Standard deviation of ``direction`` (rad)."""
        return math.sqrt(float(self.covariance[1, 1]))


def sampson_residuals(
    rays_a: ArrayLike, rays_b: ArrayLike, phi: float, direction: float
) -> tuple[Array, Array]:
    """Return the Sampson residuals (N,) in rad of unit rays (N, 3), and ∂/∂(φ, θ) (N, 2).

    The residual is the algebraic error over the norm of its gradient by both rays: to first
    order its standard deviation is that of one ray's direction.
    """
    linear = RayPairs.of(rays_a, rays_b).linearised([(phi, direction)])
    return linear.residual, linear.jacobian.T


def ransac_planar_motion(
    rays_a: ArrayLike,
    rays_b: ArrayLike,
    sigma: float,
    *,
    seed: int = 0,
    threshold_sigmas: float = 4.0,
    hypotheses: int = 400,
) -> PlanarMotion:
    """Find the planar motion that most features agree with, and refine it on them.

    Two features fix the motion up to two solutions; all hypotheses are scored in one array
    operation by the truncated sum of squared Sampson residuals.

    Parameters
    ----------
    rays_a, rays_b : (N, 3) arrays
        Unit rays of the same features in both views.
    sigma : float
        Standard deviation of one ray's direction (rad).
    seed : int
        Of the random samples; the same seed gives the same result.
    threshold_sigmas : float
        Residual (in ``sigma``) beyond which a feature counts as an outlier.
    hypotheses : int
        Number of two-point samples.
    """
    a, b = np.asarray(rays_a, dtype=np.float64), np.asarray(rays_b, dtype=np.float64)
    if len(a) < MINIMUM_FEATURES:
        return _too_few(len(a))
    limit = threshold_sigmas * sigma
    found = ransac(
        distinct_samples(len(a), 2, hypotheses, seed),
        lambda samples: two_point_motions(a[samples], b[samples]),
        lambda angles: squared_residuals(a, b, angles),
        limit**2,
    )
    theta, alpha = found.models[0].tolist()
    phi, direction = alpha - theta, _towards_points(a, b, alpha - theta, theta, sigma)
    inliers = found.inliers & _plausible(a, b, phi, direction, limit)
    motion = _too_few(len(a))
    for _ in range(2):
        if inliers.sum() < MINIMUM_FEATURES:
            return _too_few(len(a), int(inliers.sum()))
        motion = refine_planar_motion(a[inliers], b[inliers], phi, direction, sigma)
        phi, direction = motion.phi, motion.direction
        residual, _ = sampson_residuals(a, b, phi, direction)
        inliers = (np.abs(residual) < limit) & _plausible(a, b, phi, direction, limit)
    return replace(motion, inliers=inliers)


def refine_planar_motion(
    rays_a: ArrayLike,
    rays_b: ArrayLike,
    phi0: float,
    direction0: float,
    sigma: float,
    *,
    iterations: int = 15,
) -> PlanarMotion:
    """Refine a planar motion from a start by soft-L1 Gauss–Newton on Sampson residuals.

    Parameters
    ----------
    rays_a, rays_b : (N, 3) arrays
        Unit rays of the same features in both views; some may be outliers.
    phi0, direction0 : float
        Where to start (rad); the sign of the direction is found anew.
    sigma : float
        Standard deviation of one ray's direction (rad).
    iterations : int
        At most this many steps.
    """
    pairs = RayPairs.of(rays_a, rays_b)
    return refine_motions(pairs, [(phi0, direction0)], sigma, iterations=iterations)[0]


def refine_motions(
    pairs: RayPairs,
    starts: Sequence[tuple[float, float]],
    sigma: float | Array,
    *,
    limit_sigmas: float = math.inf,
    present: Mask | None = None,
    iterations: int = 15,
) -> list[PlanarMotion]:
    """Refine the planar motions of several pairs of views, or several of one, in one go.

    Parameters
    ----------
    pairs : RayPairs
    starts : (phi, direction) in rad, one a motion
    sigma : float or (P,) array
        Standard deviation of one ray's direction (rad), of all pairs or of each.
    limit_sigmas : float
        Features with residuals larger than so many ``sigma`` do not count, while most have
        smaller ones.
    present : (P, N) array or None
        Features that a pair has at all; None for all.
    iterations : int
        At most this many steps.
    """
    if pairs.features < MINIMUM_FEATURES:
        return [_too_few(pairs.features) for _ in starts]
    fits = fit(
        pairs,
        starts,
        sigma,
        limit_sigmas=limit_sigmas,
        present=present,
        iterations=iterations,
    )
    return [_motion(found) for found in fits]


def _motion(found: MotionFit) -> PlanarMotion:
    agreeing = int(np.count_nonzero(found.inliers))
    if agreeing < MINIMUM_FEATURES:
        return _too_few(len(found.inliers), agreeing)
    pp, pt, tt = found.variance
    covariance = np.array([[pp, pt], [pt, tt]])
    return PlanarMotion(found.phi, found.direction, covariance, found.inliers, found.degeneracy)


def squared_residuals(a: Array, b: Array, angles: Array) -> Array:
    """Return squared Sampson residuals (H, N) of motions (θ, α), (H, 2), for N features.

    The error is linear in the cosines and sines of both angles, its squared gradient in those of
    twice the angles: two matrix products.
    """
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    forth, back = np.exp(1j * angles.T)
    error: Array = np.stack([forth.real, forth.imag, back.real, back.imag], axis=1) @ np.stack(
        [bz * ax, -bz * ay, -az * bx, az * by]
    )
    forth, back = forth * forth, back * back
    ones = np.ones(len(angles))
    level = az * az + bz * bz + 0.5 * (ax * ax + ay * ay + bx * bx + by * by)
    gradient = np.stack([ones, forth.real, forth.imag, back.real, back.imag], axis=1) @ np.stack(
        [level, 0.5 * (ax * ax - ay * ay), -ax * ay, 0.5 * (bx * bx - by * by), -bx * by]
    )
    # What rounding leaves of a gradient that vanishes.
    np.maximum(gradient, 1e-15, out=gradient)
    error *= error
    error /= gradient
    return error


def _towards_points(a: Array, b: Array, phi: float, direction: float, sigma: float) -> float:
    """Return ``direction`` or its opposite: the one that puts points in front of both views."""
    # Far points vote with less weight, gross errors with no more than a good point.
    votes = np.tanh(signed_parallax(a, b, phi, direction) / max(3.0 * sigma, 1e-12))
    return float(wrap_angle(direction if votes.sum() >= 0.0 else direction + np.pi))


def _plausible(a: Array, b: Array, phi: float, direction: float, limit: float) -> Mask:
    """Return whether each feature's parallax (N,) is one that a point of the scene can have.

    An outlier that happens to lie near its epipolar plane passes the residual test, and with a
    short baseline its huge parallax would outweigh all others.
    """
    parallax = signed_parallax(a, b, phi, direction)
    usual = float(np.median(np.abs(parallax)))
    return np.asarray((parallax > -2.0 * limit) & (parallax < max(NEAREST * usual, 2.0 * limit)))


def _too_few(count: int, agreeing: int | None = None) -> PlanarMotion:
    found = f"{count} features" if agreeing is None else f"{agreeing} of {count} features agree"
    return PlanarMotion(
        0.0,
        0.0,
        np.diag([np.inf, np.inf]),
        np.zeros(count, dtype=np.bool_),
        Degeneracy.TOO_FEW,
        f"{found}, {MINIMUM_FEATURES} are needed",
    )
