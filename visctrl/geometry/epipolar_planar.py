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

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robots.unicycle import wrapped
from visctrl.geometry.epipolar_points import (
    LinearPoints,
    NoiseSums,
    PointPairs,
    Vector,
    complement,
)
from visctrl.geometry.planar import PlanarMotion
from visctrl.geometry.robust_fit import (
    Delta,
    Descent,
    Normal,
    Settled,
    medians,
    products,
    settle,
    some,
)
from visctrl.plugins import Health

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Three features fix m; fewer than this leave no residual to judge it by.
MINIMUM_FEATURES = 5
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
#: Parallax (in a coordinate's noise) from which a feature has a full vote, and that which it may
#: have against the others.
_FULL_VOTE_SIGMAS, _BEHIND_SIGMAS = 3.0, 8.0
#: Why a motion is not determined although the views differ.
ONE_PLANE = (
    "all features lie in one plane, and two motions explain them: let the camera see things at "
    "different distances"
)
#: Why the epipoles are not determined although their turn is.
SHORT_BASELINE = "short baseline: the direction of the epipoles is not determined"
#: Hypotheses that are refined before the best is chosen, and by how many steps.
_FINALISTS, _FINALIST_STEPS = 4, 2
#: Steps on the best of them, at most, and the longest.
_STEPS, _LONGEST_STEP = 12, 0.3


@dataclass(frozen=True)
class PlanarEpipoles(PlanarMotion):
    """A planar motion whose bearings are in the units of an assumed calibration.

    ``phi`` is the difference of the baseline's two bearings, B's heading if that calibration
    is right.

    vector : m = (c_a, s_a, c_b, s_b) of unit length, pointing from A's centre to B's.
    """

    vector: Vector = (0.0, 0.0, 0.0, 0.0)


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
    """Return the Sampson residuals (N,) of points (N, 2) for m (4,), and ∂/∂m (4, N).

    To first order a residual has the standard deviation of one image coordinate.
    """
    vector = np.asarray(m, dtype=np.float64)
    length = float(np.linalg.norm(vector))
    linear = PointPairs.of(points_a, points_b).linearised([_vector(vector / length)])
    # The residual is the same for any length of m: nothing changes along m itself.
    return linear.residual, np.array(linear.axes[0]).T @ linear.jacobian / length


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
    pairs = PointPairs.of(points_a, points_b)
    if pairs.features < MINIMUM_FEATURES:
        return _too_few(pairs.features)
    m = null_vectors(pairs.rows.T[_samples(pairs.features, hypotheses, seed)])
    limit = threshold_sigmas * sigma
    cost = np.minimum(pairs.squared(m), limit**2).sum(axis=-1)
    best = m[np.argpartition(cost, _FINALISTS)[:_FINALISTS]]
    descents = [_Epipoles(_vector(start), _FINALIST_STEPS, _LONGEST_STEP) for start in best]
    several = PointPairs.of(points_a, points_b, len(descents))
    settle(several.linearised, descents, sigma, limit=limit)
    ends = [descent.ahead for descent in descents]
    cost = np.minimum(pairs.squared(np.array(ends)), limit**2).sum(axis=-1)
    return refine_epipoles(pairs, [ends[int(np.argmin(cost))]], sigma, limit=limit)[0]


def refine_planar_epipoles(
    points_a: ArrayLike,
    points_b: ArrayLike,
    start: Vector,
    sigma: float,
    *,
    threshold_sigmas: float = 4.0,
) -> PlanarEpipoles:
    """Refine planar epipoles from a nearby start; arguments as for `ransac_planar_epipoles`.

    Parameters
    ----------
    start : m to start from.
    """
    pairs = PointPairs.of(points_a, points_b)
    return refine_epipoles(pairs, [start], sigma, limit=threshold_sigmas * sigma)[0]


def refine_epipoles(
    pairs: PointPairs,
    starts: Sequence[Vector],
    sigma: float,
    *,
    limit: float,
    present: Mask | None = None,
) -> list[PlanarEpipoles]:
    """Refine the planar epipoles of several pairs of views in one go.

    Parameters
    ----------
    pairs : PointPairs
    starts : m to start from, one a pair
        Their senses are found anew.
    sigma : float
        Standard deviation of one coordinate.
    limit : float
        Features with larger residuals are outliers.
    present : (P, N) array or None
        Features that a pair has at all; None for all.
    """
    if pairs.features < MINIMUM_FEATURES:
        return [_too_few(pairs.features) for _ in starts]
    usable = None if present is None else present.ravel()
    directed, plausible = _directed(pairs, starts, sigma, usable)
    descents = [_Epipoles(start, _STEPS, _LONGEST_STEP) for start in directed]
    settled = settle(pairs.linearised, descents, sigma, limit=limit, usable=plausible)
    return _judged(pairs, [descent.ahead for descent in descents], settled, limit, sigma)


def turned(m: Vector, turn_a: float = 0.0, turn_b: float = 0.0) -> Vector:
    """Return m after the views turned by ``turn_a``, ``turn_b`` (rad, counter-clockwise)."""
    c, s, c_b, s_b = math.cos(turn_a), math.sin(turn_a), math.cos(turn_b), math.sin(turn_b)
    # A turn to the left moves every bearing to the right.
    return (
        c * m[0] - s * m[1],
        s * m[0] + c * m[1],
        c_b * m[2] - s_b * m[3],
        s_b * m[2] + c_b * m[3],
    )


def _samples(count: int, hypotheses: int, seed: int) -> NDArray[np.int64]:
    """Return (hypotheses, 3) triples of distinct indices below ``count``."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, count, hypotheses)
    step = rng.integers(1, count, hypotheses)
    # A third index that skips the two taken ones, drawn uniformly from the rest.
    other = rng.integers(1, count - 1, hypotheses)
    other += other >= step
    return np.stack([first, (first + step) % count, (first + other) % count], axis=-1)


class _Epipoles(Descent[Vector]):
    """Descent of one pair's m over the unit vectors."""

    def solve(self, normal: Normal, damping: float) -> tuple[Delta, float]:
        """Return the step along the three vectors across m, and −gᵀ δ (see the base)."""
        (a, b, c), (_, d, e), (_, _, f), (u, v, w) = normal
        # A direction without information is held by a part of the others'.
        floor = 1e-9 * max(a + d + f, 1e-12)
        grown = 1.0 + damping
        a, d, f = a * grown + floor, d * grown + floor, f * grown + floor
        # H = L D Lᵀ, positive definite for its damping.
        l_21, l_31 = b / a, c / a
        d_2 = d - l_21 * b
        l_32 = (e - l_21 * c) / d_2
        d_3 = f - l_31 * c - l_32 * l_32 * d_2
        y = v - l_21 * u
        r = -(w - l_31 * u - l_32 * y) / d_3
        q = -y / d_2 - l_32 * r
        p = -u / a - l_21 * q - l_31 * r
        return (p, q, r), -(p * u + q * v + r * w)

    def moved(self, point: Vector, delta: Delta, part: float) -> Vector:
        """Return m after a part of a step."""
        p, q, r = (part * change for change in delta)
        axes = complement(point)
        after = [m + p * x + q * y + r * z for m, x, y, z in zip(point, *axes, strict=True)]
        length = math.sqrt(sum(m * m for m in after))
        return _vector(m / length for m in after)


def _directed(
    pairs: PointPairs, starts: Sequence[Vector], sigma: float, usable: Mask | None
) -> tuple[list[Vector], Mask | None]:
    """Return each m or −m, whichever puts the points in front of the views, and who agrees.

    None stands for all. A feature agrees when its parallax is one that a point of the scene can
    have. An outlier that happens to lie near its epipolar plane passes the residual test, and
    with a short baseline its huge parallax would outweigh all others.
    """
    parallax = pairs.parallax(starts)
    # Far points vote with less weight, gross errors with no more than a good point.
    votes = np.tanh(parallax * (1.0 / (_FULL_VOTE_SIGMAS * sigma)))
    if usable is not None:
        votes *= usable
    sums = votes.reshape(len(starts), -1).sum(axis=1).tolist()
    senses = [1.0 if vote >= 0.0 else -1.0 for vote in sums]
    (usual,) = medians(np.abs(parallax)[None], len(starts), usable)
    noise = _BEHIND_SIGMAS * sigma
    nearest = [max(_NEAREST * value, noise) for value in usual]
    sense, limit = np.repeat(np.array([senses, nearest]), pairs.features, axis=1)
    parallax *= sense
    plausible = (parallax > -noise) & (parallax < limit)
    if usable is not None:
        plausible &= usable
    directed = [_vector(s * e for e in m) for s, m in zip(senses, starts, strict=True)]
    return directed, some(plausible)


def _judged(
    pairs: PointPairs,
    vectors: Sequence[Vector],
    settled: Settled[LinearPoints],
    limit: float,
    sigma: float,
) -> list[PlanarEpipoles]:
    """Return the epipoles at m, what they are known by and what is not determined."""
    (linear, weights, inside), problems = settled, len(vectors)
    shown = np.array([np.abs(linear.residual), pairs.traces() / linear.variance - 1.0])
    inliers = shown[0] < limit
    if inside is not None:
        inliers &= inside
    misfit, usual = medians(shown, problems, some(inliers))
    # Residuals larger than promised widen the covariance; smaller ones do not narrow it. None
    # exceed the limit but for the median of no inliers at all, which is infinite.
    units = [max(sigma, 1.4826 * min(size, 1.0)) ** 2 for size in misfit]
    # Features close to both the baseline and the horizon have rows of nothing but noise.
    loud = np.repeat(np.array([_MAX_NOISE * value for value in usual]), pairs.features)
    weights = weights * (inliers & (shown[1] < loud))
    information = products(linear.jacobian * weights, linear.jacobian, problems)
    values, turns = np.linalg.eigh(np.array(information))
    axes = (turns.swapaxes(1, 2) @ np.array(linear.axes)).tolist()
    noise = pairs.noise_sums(weights / linear.variance, problems)
    known = [_known(*each) for each in zip(values.tolist(), axes, noise, units, strict=True)]
    agreeing = inliers.reshape(problems, -1)
    moved = [True] * problems
    if not all(determined[0] for determined, _ in known):
        (parallax,) = medians(np.abs(pairs.parallax(vectors))[None], problems, some(inliers))
        moved = [p > _MOVED_SIGMAS * math.sqrt(u) for p, u in zip(parallax, units, strict=True)]
    return [
        _epipoles(m, agreeing[k], axes[k], *known[k], moved=moved[k]) for k, m in enumerate(vectors)
    ]


def _known(
    values: list[float], axes: list[Vector], noise: NoiseSums, unit: float
) -> tuple[list[bool], list[float]]:
    """Return whether m is determined along three axes, and its variances.

    With a short baseline, noise alone makes the rows of the constraint differ; its share is
    taken out of the information ``values``, or an undetermined direction would look known.
    ``unit`` is the variance of a residual.
    """
    determined, variances = [], []
    for value, axis in zip(values, axes, strict=True):
        share, doubt = noise.along(axis)
        clear = value - unit * share
        determined.append(clear > _SIGNIFICANCE * math.sqrt(2.0) * unit * doubt)
        # Of an undetermined direction of the unit vector m nothing is known.
        variances.append(unit / max(clear, 1e-300) if determined[-1] else 1.0)
    return determined, variances


def _epipoles(
    m: Vector,
    inliers: Mask,
    axes: list[Vector],
    determined: list[bool],
    variances: list[float],
    *,
    moved: bool,
) -> PlanarEpipoles:
    count = int(np.count_nonzero(inliers))
    if count < MINIMUM_FEATURES:
        found = f"{count} of {len(inliers)} features fit one motion, {MINIMUM_FEATURES} are needed"
        return _lost(len(inliers), f"no agreement: {found}")
    covariance, var_b = _covariance(m, axes, variances)
    reason = _problem(determined, max(covariance[1][1], var_b), moved=moved)
    direction, bearing_b = math.atan2(m[1], m[0]), math.atan2(m[3], m[2])
    return PlanarEpipoles(
        wrapped(bearing_b - direction),
        direction,
        np.array(covariance),
        inliers,
        Health.DEGENERATE if reason else Health.OK,
        reason,
        m,
    )


def _covariance(
    m: Vector, axes: list[Vector], variances: list[float]
) -> tuple[list[list[float]], float]:
    """Return the covariance (2, 2) of (phi, direction) and the variance of the other bearing.

    ``variances`` are those of m along three ``axes``.
    """
    length_a, length_b = m[0] ** 2 + m[1] ** 2, m[2] ** 2 + m[3] ** 2
    pp = pt = tt = bb = 0.0
    for (p, q, r, s), variance in zip(axes, variances, strict=True):
        by_direction = (m[0] * q - m[1] * p) / length_a
        by_bearing_b = (m[2] * s - m[3] * r) / length_b
        turn = by_bearing_b - by_direction
        pp += variance * turn * turn
        pt += variance * turn * by_direction
        tt += variance * by_direction * by_direction
        bb += variance * by_bearing_b * by_bearing_b
    return [[pp, pt], [pt, tt]], bb


def _problem(determined: list[bool], widest: float, *, moved: bool) -> str:
    """Return the name of what is not determined, if anything; ``widest`` is a variance (rad²)."""
    if not determined[1]:
        return "features clustered: they do not separate turning from moving"
    if not determined[0] and moved:
        return ONE_PLANE
    if not determined[0] or widest > _MAX_SD**2:
        return SHORT_BASELINE
    return ""


def _vector(elements: Iterable[float]) -> Vector:
    p, q, r, s = elements
    return float(p), float(q), float(r), float(s)


def _too_few(count: int) -> PlanarEpipoles:
    return _lost(count, f"too few features: {count}, {MINIMUM_FEATURES} are needed")


def _lost(count: int, reason: str) -> PlanarEpipoles:
    unknown = np.diag([np.inf, np.inf])
    return PlanarEpipoles(0.0, 0.0, unknown, np.zeros(count, dtype=np.bool_), Health.LOST, reason)
