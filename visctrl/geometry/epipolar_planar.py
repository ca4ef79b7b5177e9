"""Epipoles of two views of a perspective camera that moves in a plane, without calibration.

Image points are (x, y) = (right, up)/forward for an *assumed* focal length and image centre.
With the baseline along the bearings θ_a and θ_b of the two views, planar motion gives

    y_b (x_a c_a − s_a) − y_a (x_b c_b − s_b) = 0,   tan θ = s/c,

linear in m = (c_a, s_a, c_b, s_b). A wrong focal length or centre column is a linear change of
x that m absorbs: it only makes the norms of (c_a, s_a) and (c_b, s_b) differ. So with these
norms left free the epipoles come out in the very units of the points, whatever the true focal
length, and one at infinity (c = 0) is as good as any other. Only the horizon's row must be known.
`visctrl.geometry.planar` is the calibrated counterpart, with equal norms, for any central camera.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robots.unicycle import wrap_angle
from visctrl.geometry.planar import PlanarMotion, signed_parallax
from visctrl.plugins import Health

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Three features fix m; fewer than this leave no residual to judge it by.
MINIMUM_FEATURES = 5
#: Scale of the soft-L1 kernel in standard deviations of the residual.
_KERNEL_SIGMAS = 1.5
#: A direction of m shows when its information exceeds the noise's by this many deviations.
_SIGNIFICANCE = 5.0
#: Standard deviation (rad) of an epipole's bearing beyond which it counts as undetermined.
_MAX_SD = 0.5
#: A feature's parallax is at most this many times the usual one.
_NEAREST = 10.0
#: Noise of a row, in multiples of the usual one, beyond which it says nothing.
_MAX_NOISE = 10.0
#: Hypotheses that are refined before the best is chosen.
_FINALISTS = 4


@dataclass(frozen=True)
class PlanarEpipoles(PlanarMotion):
    """A planar motion whose bearings are in the units of an assumed calibration.

    ``phi`` is the difference of the baseline's two bearings, B's heading if that calibration
    is right.

    vector : (4,), m = (c_a, s_a, c_b, s_b) of unit length, pointing from A's centre to B's.
    """

    vector: Array = field(default_factory=lambda: np.zeros(4))


def constraint_rows(points_a: ArrayLike, points_b: ArrayLike) -> Array:
    """Return the coefficients (..., 4) of m in the constraint of points (..., 2)."""
    a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    xa, ya, xb, yb = a[..., 0], a[..., 1], b[..., 0], b[..., 1]
    return np.stack([yb * xa, -yb, -ya * xb, ya], axis=-1)


def null_vectors(rows: ArrayLike) -> Array:
    """Return the unit vectors (..., 4) orthogonal to the three rows of (..., 3, 4) matrices."""
    M = np.asarray(rows, dtype=np.float64)
    p, q, r = M[..., 0, :], M[..., 1, :], M[..., 2, :]
    # 2×2 minors of the last two rows, then expansion along the first: a cross product in 4D.
    minor = {
        (i, j): q[..., i] * r[..., j] - q[..., j] * r[..., i] for i in range(4) for j in range(i)
    }

    def cofactor(i: int, j: int, k: int) -> Array:
        return np.asarray(
            p[..., i] * minor[k, j] - p[..., j] * minor[k, i] + p[..., k] * minor[j, i]
        )

    m = np.stack([cofactor(1, 2, 3), -cofactor(0, 2, 3), cofactor(0, 1, 3), -cofactor(0, 1, 2)], -1)
    length = np.linalg.norm(m, axis=-1, keepdims=True)
    # Dependent rows (repeated features, identical views) have no null vector of their own.
    usual = np.sqrt(0.5) * np.array([1.0, 0.0, 1.0, 0.0])
    return np.asarray(np.where(length > 1e-300, m / np.maximum(length, 1e-300), usual))


def sampson_residuals(
    points_a: ArrayLike, points_b: ArrayLike, m: ArrayLike
) -> tuple[Array, Array]:
    """Return the Sampson residuals (..., N) of points (N, 2) for m (..., 4), and ∂/∂m (..., 4, N).

    To first order a residual has the standard deviation of one image coordinate.
    """
    xa, ya = np.asarray(points_a, dtype=np.float64).T
    xb, yb = np.asarray(points_b, dtype=np.float64).T
    m = np.asarray(m, dtype=np.float64)
    ca, sa, cb, sb = (m[..., k, None] for k in range(4))
    across_a, across_b = xa * ca - sa, xb * cb - sb
    along_a, along_b = yb * ca, ya * cb
    variance = along_a**2 + along_b**2 + across_a**2 + across_b**2
    scale = 1.0 / np.sqrt(np.maximum(variance, 1e-18))
    residual = (yb * across_a - ya * across_b) * scale
    change = residual * scale
    jacobian = np.empty((*residual.shape[:-1], 4, residual.shape[-1]))
    jacobian[..., 0, :] = xa * (yb - change * across_a) - change * yb * along_a
    jacobian[..., 1, :] = change * across_a - yb
    jacobian[..., 2, :] = -xb * (ya + change * across_b) - change * ya * along_b
    jacobian[..., 3, :] = change * across_b + ya
    jacobian *= scale[..., None, :]
    return residual, jacobian


def ransac_planar_epipoles(
    points_a: ArrayLike,
    points_b: ArrayLike,
    sigma: float,
    *,
    seed: int = 0,
    threshold_sigmas: float = 4.0,
    hypotheses: int = 96,
) -> PlanarEpipoles:
    """Find the planar epipolar geometry that most features agree with, and refine it on them.

    Parameters
    ----------
    points_a, points_b : (N, 2) arrays
        (right, up)/forward of the same features in both views, by the assumed calibration.
    sigma : float
        Standard deviation of one coordinate.
    seed : int
        Of the random samples; the same seed gives the same result.
    threshold_sigmas : float
        Residual (in ``sigma``) beyond which a feature counts as an outlier.
    hypotheses : int
        Number of three-point samples, all scored in one array operation.
    """
    a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    if len(a) < MINIMUM_FEATURES:
        return _lost(len(a), f"too few features: {len(a)}, {MINIMUM_FEATURES} are needed")
    m = null_vectors(constraint_rows(a, b)[_samples(len(a), hypotheses, seed)])
    limit = threshold_sigmas * sigma
    cost = np.minimum(_squared_residuals(a, b, m), limit**2).sum(axis=-1)
    best = m[np.argpartition(cost, _FINALISTS)[:_FINALISTS]]
    best = _descend(a, b, best, _squared_residuals(a, b, best) < limit**2, sigma, iterations=2)
    squared = _squared_residuals(a, b, best)
    winner = int(np.argmin(np.minimum(squared, limit**2).sum(axis=-1)))
    forward, plausible = _directed(a, b, best[winner], sigma)
    near = plausible & (squared[winner] < limit**2)
    return _settle(a, b, forward, near, plausible, sigma, limit)


def refine_planar_epipoles(
    points_a: ArrayLike,
    points_b: ArrayLike,
    start: ArrayLike,
    sigma: float,
    *,
    threshold_sigmas: float = 4.0,
) -> PlanarEpipoles:
    """Refine planar epipoles from a nearby start; arguments as for `ransac_planar_epipoles`.

    Parameters
    ----------
    start : (4,) array
        m to start from. Features more than twice the threshold away from it are outliers.
    """
    a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    m = np.asarray(start, dtype=np.float64)
    limit = threshold_sigmas * sigma
    if len(a) < MINIMUM_FEATURES:
        return _lost(len(a), f"too few features: {len(a)}, {MINIMUM_FEATURES} are needed")
    forward, plausible = _directed(a, b, m, sigma)
    near = plausible & (_squared_residuals(a, b, m[None])[0] < (2.0 * limit) ** 2)
    return _settle(a, b, forward, near, plausible, sigma, limit)


def turned(m: ArrayLike, turn_a: float = 0.0, turn_b: float = 0.0) -> Array:
    """Return m (4,) after the views turned by ``turn_a``, ``turn_b`` (rad, counter-clockwise)."""
    m = np.asarray(m, dtype=np.float64)
    result = np.empty(4)
    for k, turn in ((0, turn_a), (2, turn_b)):
        c, s = np.cos(turn), np.sin(turn)
        # A turn to the left moves every bearing to the right.
        result[k], result[k + 1] = c * m[k] - s * m[k + 1], s * m[k] + c * m[k + 1]
    return result


def _settle(
    a: Array, b: Array, m: Array, near: Mask, plausible: Mask, sigma: float, limit: float
) -> PlanarEpipoles:
    """Refine m on the features ``near`` it and judge the result on all ``plausible`` ones."""
    final, inliers = m[None], near
    for iterations in (3, 2):
        if int(inliers.sum()) >= MINIMUM_FEATURES:
            final = _descend(a, b, final, inliers, sigma, iterations)
            inliers = plausible & (_squared_residuals(a, b, final)[0] < limit**2)
    count = int(inliers.sum())
    if count < MINIMUM_FEATURES:
        found = f"{count} of {len(a)} features fit one motion, {MINIMUM_FEATURES} are needed"
        return _lost(len(a), f"no agreement: {found}")
    return _finish(a, b, final[0], inliers, sigma)


def _samples(count: int, hypotheses: int, seed: int) -> NDArray[np.int64]:
    """Return (hypotheses, 3) triples of distinct indices below ``count``."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, count, hypotheses)
    step = rng.integers(1, count, hypotheses)
    # A third index that skips the two taken ones, drawn uniformly from the rest.
    other = rng.integers(1, count - 1, hypotheses)
    other += other >= step
    return np.stack([first, (first + step) % count, (first + other) % count], axis=-1)


def _squared_residuals(a: Array, b: Array, m: Array) -> Array:
    """Return squared Sampson residuals (H, N) for hypotheses (H, 4)."""
    across_a = np.outer(m[:, 0], a[:, 0]) - m[:, 1:2]
    across_b = np.outer(m[:, 2], b[:, 0]) - m[:, 3:4]
    error = b[:, 1] * across_a - a[:, 1] * across_b
    variance = np.outer(m[:, 0] ** 2, b[:, 1] ** 2) + np.outer(m[:, 2] ** 2, a[:, 1] ** 2)
    variance += across_a**2 + across_b**2
    return np.asarray(error * error / np.maximum(variance, 1e-18))


def _descend(a: Array, b: Array, m: Array, inside: Mask, sigma: float, iterations: int) -> Array:
    """Return the m (H, 4) after soft-L1 Gauss–Newton steps on the features ``inside``."""
    for _ in range(iterations):
        residual, jacobian = sampson_residuals(a, b, m)
        weighted = (inside * _weights(residual / sigma))[:, None, :] * jacobian
        H = weighted @ np.swapaxes(jacobian, -1, -2)
        gradient = weighted @ residual[..., None]
        # The length of m is free: a stiffness along m itself keeps H regular. The rest of the
        # damping bounds the step along a direction without information.
        size = np.maximum(np.trace(H, axis1=-2, axis2=-1), 1e-12)[:, None, None]
        H += (m[:, :, None] * m[:, None, :] + 1e-9 * np.eye(4)) * size
        step = -np.linalg.solve(H, gradient)[..., 0]
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        m = m + step * np.minimum(1.0, 0.3 / np.maximum(length, 1e-12))
        m = m / np.linalg.norm(m, axis=-1, keepdims=True)
    return m


def _weights(scaled: Array) -> Array:
    return np.asarray(1.0 / np.sqrt(1.0 + (scaled / _KERNEL_SIGMAS) ** 2))


def _finish(a: Array, b: Array, m: Array, inliers: Mask, sigma: float) -> PlanarEpipoles:
    a, b = a[inliers], b[inliers]
    residual, jacobian = sampson_residuals(a, b, m)
    # Residuals larger than promised widen the covariance; smaller ones do not narrow it.
    spread = max(1.0, 1.4826 * float(np.median(np.abs(residual))) / sigma)
    weights = _weights(residual / sigma)
    covariance, reason = _covariance(a, b, m, jacobian, weights, sigma * spread)
    direction, bearing_b = _bearings(m)
    health = Health.DEGENERATE if reason else Health.OK
    phi = float(wrap_angle(bearing_b - direction))
    return PlanarEpipoles(phi, direction, covariance, inliers, health, reason, m)


def _bearings(m: Array) -> tuple[float, float]:
    """Return the bearings of the baseline in views A and B (rad), up to a common half turn."""
    return float(np.arctan2(m[1], m[0])), float(np.arctan2(m[3], m[2]))


def _directed(a: Array, b: Array, m: Array, sigma: float) -> tuple[Array, Mask]:
    """Return m or −m, whichever puts the points in front of the views, and who agrees.

    A feature agrees when its parallax is one that a point of the scene can have. An outlier that
    happens to lie near its epipolar plane passes the residual test, and with a short baseline
    its huge parallax would outweigh all others.
    """
    direction, bearing_b = _bearings(m)
    parallax = signed_parallax(_rays(a), _rays(b), bearing_b - direction, direction)
    # Far points vote with less weight, gross errors with no more than a good point.
    sense = 1.0 if float(np.tanh(parallax / (3.0 * sigma)).sum()) >= 0.0 else -1.0
    forward = parallax * sense
    noise = 8.0 * sigma
    usual = float(np.median(np.abs(forward)))
    plausible = (forward > -noise) & (forward < max(_NEAREST * usual, noise))
    return sense * m, np.asarray(plausible)


def _covariance(
    a: Array, b: Array, m: Array, jacobian: Array, weights: Array, sigma: float
) -> tuple[Array, str]:
    """Return the covariance (2, 2) of (phi, direction) and the name of the degeneracy, if any.

    With a short baseline, noise alone makes the rows of the constraint differ; its share is
    taken out of the information, or an undetermined direction would look known.
    """
    basis = np.linalg.svd(m[None, :])[2][1:].T
    noise = _row_noise(a, b, m, basis)
    # Features close to both the baseline and the horizon have rows of nothing but noise.
    loudness = np.trace(noise, axis1=1, axis2=2)
    weights = np.where(loudness < _MAX_NOISE * np.median(loudness), weights, 0.0)
    noise *= weights[:, None, None]
    J = basis.T @ jacobian
    info = (weights * J) @ J.T
    values, vectors = np.linalg.eigh(info)
    shares = sigma**2 * np.einsum("ik,...ij,jk->...k", vectors, noise, vectors)
    clear = values - shares.sum(axis=0)
    determined = clear > _SIGNIFICANCE * np.sqrt(2.0 * (shares**2).sum(axis=0))
    # Of an undetermined direction of the unit vector m nothing is known.
    variances = np.where(determined, sigma**2 / np.maximum(clear, 1e-300), 1.0)
    cov_m = basis @ (vectors * variances) @ vectors.T @ basis.T
    by_direction = np.array([-m[1], m[0], 0.0, 0.0]) / (m[0] ** 2 + m[1] ** 2)
    by_bearing_b = np.array([0.0, 0.0, -m[3], m[2]]) / (m[2] ** 2 + m[3] ** 2)
    G = np.stack([by_bearing_b - by_direction, by_direction])
    covariance = G @ cov_m @ G.T
    if not determined[1]:
        return covariance, "features clustered: they do not separate turning from moving"
    if not determined[0] or max(covariance[1, 1], by_bearing_b @ cov_m @ by_bearing_b) > _MAX_SD**2:
        return covariance, "short baseline: the direction of the epipoles is not determined"
    return covariance, ""


def _row_noise(a: Array, b: Array, m: Array, basis: Array) -> Array:
    """Return the share (N, 3, 3) of each feature in the information that is noise, over σ²."""
    one, zero = np.ones(len(a)), np.zeros(len(a))
    xa, ya, xb, yb = a[:, 0], a[:, 1], b[:, 0], b[:, 1]
    by_noise = np.stack(
        [
            np.stack([yb, zero, zero, zero], -1),
            np.stack([zero, zero, -xb, one], -1),
            np.stack([zero, zero, -ya, zero], -1),
            np.stack([xa, -one, zero, zero], -1),
        ],
        axis=1,
    )
    variance = np.sum((by_noise @ m) ** 2, axis=1)
    inside = by_noise @ basis
    share = np.swapaxes(inside, 1, 2) @ inside
    return np.asarray(share / np.maximum(variance, 1e-18)[:, None, None])


def _rays(points: Array) -> Array:
    """Return unit rays (N, 3) as (right, forward, up) of image points (N, 2)."""
    rays = np.stack([points[:, 0], np.ones(len(points)), points[:, 1]], axis=-1)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def _lost(count: int, reason: str) -> PlanarEpipoles:
    unknown = np.diag([np.inf, np.inf])
    return PlanarEpipoles(0.0, 0.0, unknown, np.zeros(count, dtype=np.bool_), Health.LOST, reason)
