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
from visctrl.geometry.epipolar_points import PointPair
from visctrl.geometry.parallax import meeting
from visctrl.geometry.planar import PlanarMotion
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
#: Parallax, in a coordinate's noise, that shows that the view has moved.
_MOVED_SIGMAS = 8.0
#: Why a motion is not determined although the views differ.
ONE_PLANE = (
    "all features lie in one plane, and two motions explain them: let the camera see things at "
    "different distances"
)
#: Hypotheses that are refined before the best is chosen.
_FINALISTS = 4
#: Newton steps on the best of them, at most, and those that allow for a poor start.
_STEPS, _WIDE_STEPS = 8, 3
#: A low quantile of the squared residuals, few outliers reaching it, and a normal variance's own.
_QUANTILE, _NORMAL_QUANTILE = 0.3, 0.1485
#: A step of m shorter than this part of a coordinate's noise ends a descent.
_STILL = 1e-3
#: Squared residuals over what noise explains from which a start is far off.
_FAR_OFF = 2.0

_DIAGONAL = np.arange(4)
_DAMPING = 1e-9 * np.eye(4)


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
    pair = PointPair.of(
        np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    )
    return pair.residuals(np.asarray(m, dtype=np.float64))


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
    pair = PointPair.of(a, b)
    m = null_vectors(pair.rows.T[_samples(len(a), hypotheses, seed)])
    limit2 = (threshold_sigmas * sigma) ** 2
    cost = np.minimum(pair.squared(m), limit2).sum(axis=-1)
    best = m[np.argpartition(cost, _FINALISTS)[:_FINALISTS]]
    best = _descend(pair, best, np.ones(len(a), dtype=np.bool_), sigma, limit2, steps=2)
    squared = pair.squared(best)
    winner = int(np.argmin(np.minimum(squared, limit2).sum(axis=-1)))
    forward, plausible = _directed(pair, best[winner], sigma)
    return _settle(pair, forward, plausible, sigma, limit2)


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
    limit2 = (threshold_sigmas * sigma) ** 2
    if len(a) < MINIMUM_FEATURES:
        return _lost(len(a), f"too few features: {len(a)}, {MINIMUM_FEATURES} are needed")
    pair = PointPair.of(a, b)
    forward, plausible = _directed(pair, m, sigma)
    return _settle(pair, forward, plausible, sigma, limit2)


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
    pair: PointPair, start: Array, plausible: Mask, sigma: float, limit2: float
) -> PlanarEpipoles:
    """Refine a start on the ``plausible`` features and judge the result."""
    m = _descend(pair, start[None], plausible, sigma, limit2)
    inliers = plausible & (pair.squared(m)[0] < limit2)
    count = int(np.count_nonzero(inliers))
    if count < MINIMUM_FEATURES:
        found = f"{count} of {len(pair)} features fit one motion, {MINIMUM_FEATURES} are needed"
        return _lost(len(pair), f"no agreement: {found}")
    return _finish(pair.at(inliers), m[0], inliers, sigma)


def _samples(count: int, hypotheses: int, seed: int) -> NDArray[np.int64]:
    """Return (hypotheses, 3) triples of distinct indices below ``count``."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, count, hypotheses)
    step = rng.integers(1, count, hypotheses)
    # A third index that skips the two taken ones, drawn uniformly from the rest.
    other = rng.integers(1, count - 1, hypotheses)
    other += other >= step
    return np.stack([first, (first + step) % count, (first + other) % count], axis=-1)


def _descend(
    pair: PointPair, m: Array, usable: Mask, sigma: float, limit2: float, steps: int = _STEPS
) -> Array:
    """Return the m (H, 4) after soft-L1 Newton steps on the ``usable`` features.

    Where most features are off by more than ``sigma``, that is taken for the noise at first: a
    limit of the true one would keep a poor start on the few features that agree with it.
    """
    low = int(_QUANTILE * len(pair))
    for number in range(steps):
        residual, jacobian = pair.residuals(m)
        squared = residual * residual
        usual2 = np.partition(squared, low, axis=-1)[:, low, None] / _NORMAL_QUANTILE
        wider2 = np.maximum(1.0, usual2 / sigma**2 if number < _WIDE_STEPS else 1.0)
        weights = _weights(residual / (sigma * np.sqrt(wider2)))
        weights *= usable & (squared < limit2 * wider2)
        gradient = jacobian @ (weights * residual)[..., None]
        # The kernel's own curvature, w³, makes it a Newton step; far off that would overshoot.
        least = np.where(wider2 > _FAR_OFF, 1.0, 0.5)
        curvature = weights * np.maximum(weights * weights, least)
        H = (curvature[:, None, :] * jacobian) @ np.swapaxes(jacobian, -1, -2)
        # The length of m is free: a stiffness along m itself keeps H regular. The rest of the
        # damping bounds the step along a direction without information.
        size = np.maximum(H[:, _DIAGONAL, _DIAGONAL].sum(axis=-1), 1e-12)[:, None, None]
        H += (m[:, :, None] * m[:, None, :] + _DAMPING) * size
        step = np.linalg.solve(H, gradient)[..., 0]
        length = np.sqrt(np.sum(step * step, axis=-1, keepdims=True))
        m = m - step * np.minimum(1.0, 0.3 / np.maximum(length, 1e-12))
        m = m / np.sqrt(np.sum(m * m, axis=-1, keepdims=True))
        if length.max() < _STILL * sigma:
            break
    return m


def _weights(scaled: Array) -> Array:
    return np.asarray(1.0 / np.sqrt(1.0 + (scaled / _KERNEL_SIGMAS) ** 2))


def _finish(pair: PointPair, m: Array, inliers: Mask, sigma: float) -> PlanarEpipoles:
    residual, jacobian = pair.residuals(m)
    # Residuals larger than promised widen the covariance; smaller ones do not narrow it.
    spread = max(1.0, 1.4826 * _median(np.abs(residual)) / sigma)
    weights = _weights(residual / sigma)
    covariance, reason = _covariance(pair, m, jacobian, weights, sigma * spread)
    direction, bearing_b = _bearings(m)
    health = Health.DEGENERATE if reason else Health.OK
    phi = float(wrap_angle(bearing_b - direction))
    return PlanarEpipoles(phi, direction, covariance, inliers, health, reason, m)


def _bearings(m: Array) -> tuple[float, float]:
    """Return the bearings of the baseline in views A and B (rad), up to a common half turn."""
    return float(np.arctan2(m[1], m[0])), float(np.arctan2(m[3], m[2]))


def _usual_parallax(pair: PointPair, m: Array) -> float:
    return _median(np.abs(_parallax(pair, m)))


def _parallax(pair: PointPair, m: Array) -> Array:
    """Return the sines (N,) of the angles at the points, negative for those behind the views."""
    return meeting(_in_baseline_axes(pair.a, m[0], m[1]), _in_baseline_axes(pair.b, m[2], m[3]))


def _directed(pair: PointPair, m: Array, sigma: float) -> tuple[Array, Mask]:
    """Return m or −m, whichever puts the points in front of the views, and who agrees.

    A feature agrees when its parallax is one that a point of the scene can have. An outlier that
    happens to lie near its epipolar plane passes the residual test, and with a short baseline
    its huge parallax would outweigh all others.
    """
    parallax = _parallax(pair, m)
    # Far points vote with less weight, gross errors with no more than a good point.
    sense = 1.0 if float(np.tanh(parallax / (3.0 * sigma)).sum()) >= 0.0 else -1.0
    forward = parallax * sense
    noise = 8.0 * sigma
    usual = _median(np.abs(forward))
    plausible = (forward > -noise) & (forward < max(_NEAREST * usual, noise))
    return sense * m, np.asarray(plausible)


def _covariance(
    pair: PointPair, m: Array, jacobian: Array, weights: Array, sigma: float
) -> tuple[Array, str]:
    """Return the covariance (2, 2) of (phi, direction) and the name of the degeneracy, if any.

    With a short baseline, noise alone makes the rows of the constraint differ; its share is
    taken out of the information, or an undetermined direction would look known.
    """
    basis = _complement(m)
    own = pair.noise(m[None])
    # Features close to both the baseline and the horizon have rows of nothing but noise.
    loudness = pair.noise(basis).sum(axis=0) / own[0]
    weights = np.where(loudness < _MAX_NOISE * _median(loudness), weights, 0.0)
    J = basis @ jacobian
    values, vectors = np.linalg.eigh((weights * J) @ J.T)
    axes = vectors.T @ basis
    shares = sigma**2 * weights * pair.noise(axes) / own
    clear = values - shares.sum(axis=1)
    determined = clear > _SIGNIFICANCE * np.sqrt(2.0 * (shares**2).sum(axis=1))
    # Of an undetermined direction of the unit vector m nothing is known.
    variances = np.where(determined, sigma**2 / np.maximum(clear, 1e-300), 1.0)
    cov_m = (axes.T * variances) @ axes
    by_direction = np.array([-m[1], m[0], 0.0, 0.0]) / (m[0] ** 2 + m[1] ** 2)
    by_bearing_b = np.array([0.0, 0.0, -m[3], m[2]]) / (m[2] ** 2 + m[3] ** 2)
    G = np.stack([by_bearing_b - by_direction, by_direction])
    covariance = G @ cov_m @ G.T
    if not determined[1]:
        return covariance, "features clustered: they do not separate turning from moving"
    if not determined[0] and _usual_parallax(pair, m) > _MOVED_SIGMAS * sigma:
        return covariance, ONE_PLANE
    if not determined[0] or max(covariance[1, 1], by_bearing_b @ cov_m @ by_bearing_b) > _MAX_SD**2:
        return covariance, "short baseline: the direction of the epipoles is not determined"
    return covariance, ""


def _complement(m: Array) -> Array:
    """Return three orthonormal vectors (3, 4) orthogonal to the unit vector m (4,)."""
    p, q, r, s = (float(value) for value in m)
    return np.array([[-q, p, -s, r], [-r, s, p, -q], [-s, -r, q, p]])


def _in_baseline_axes(points: Array, c: float, s: float) -> Array:
    """Return unit rays (3, N) of image points (N, 2): along, across and above the baseline."""
    x, y = points.T
    scale = 1.0 / np.sqrt(1.0 + x**2 + y**2)
    length = max(float(np.hypot(c, s)), 1e-300)
    c, s = c / length, s / length
    return np.stack([scale * (c + s * x), scale * (c * x - s), scale * y])


def _median(values: Array) -> float:
    """Return the (upper) median of values (N,): a sort less than NumPy's."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])


def _lost(count: int, reason: str) -> PlanarEpipoles:
    unknown = np.diag([np.inf, np.inf])
    return PlanarEpipoles(0.0, 0.0, unknown, np.zeros(count, dtype=np.bool_), Health.LOST, reason)
