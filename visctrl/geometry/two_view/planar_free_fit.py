"""The robust minimum of points' epipolar residuals, and what it determines.

See `planar_free_residuals`. For what is determined, m is a unit vector: its changes are
counted in the lengths of steps along three orthonormal axes across it, which turn the baseline
in view A, in view B, and change the ratio of the two parts' lengths ρ_a and ρ_b.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.robust.least_squares import levenberg_marquardt
from visctrl.geometry.robust.scale import MAD_TO_SD
from visctrl.geometry.robust.soft_l1 import (
    KERNEL_SIGMAS,
    Delta,
    Normal,
    Settled,
    SoftL1Problem,
    medians,
    options,
    products,
    some,
)
from visctrl.geometry.two_view.degeneracy import Degeneracy
from visctrl.geometry.two_view.planar_free_residuals import LinearPoints, Lines, PointPairs
from visctrl.robots.unicycle import wrapped

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

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
#: Longest step.
_LONGEST_STEP = 0.3


class LinesFit(NamedTuple):
    """The least residuals of one pair of views.

    lines : (φ, θ, λ), the baseline pointing to where most features are in front.
    variance : of φ, of both together and of θ (rad²).
    inliers : (N,) features that agree.
    degeneracy : what is not determined, if anything.
    """

    lines: Lines
    variance: tuple[float, float, float]
    inliers: Mask
    degeneracy: Degeneracy | None


def fit(
    pairs: PointPairs,
    starts: Sequence[Lines],
    sigma: float,
    *,
    limit: float,
    usable: Mask | None = None,
    iterations: int,
) -> list[LinesFit]:
    """Return the soft-L1 minimum of each pair's residuals near a start.

    Parameters
    ----------
    pairs : PointPairs
    starts : (φ, θ, λ), one a pair
        Their senses are found anew.
    sigma : float
        Standard deviation of one coordinate.
    limit : float
        Features with larger residuals are outliers.
    usable : (P N,) array or None
        Features that a pair has at all; None for all.
    iterations : int
        At most this many steps.
    """
    directed, plausible = _directed(pairs, starts, sigma, usable)
    ends, settled = descend(
        pairs, directed, sigma, limit=limit, usable=plausible, iterations=iterations
    )
    return _judged(pairs, ends, settled, limit, sigma)


def descend(
    pairs: PointPairs,
    starts: Sequence[Lines],
    sigma: float,
    *,
    limit: float,
    usable: Mask | None = None,
    iterations: int,
) -> tuple[list[Lines], Settled[LinearPoints]]:
    """Return where the residuals are least; arguments as for `fit`."""
    unit = KERNEL_SIGMAS * sigma

    problem = _LinesProblem(pairs, unit, limit / unit, usable)
    found = levenberg_marquardt(problem, starts, options(iterations, _LONGEST_STEP))
    return found.points, found.linear


class _LinesProblem(SoftL1Problem[Lines, LinearPoints]):
    """Epipolar lines (φ, θ, λ) of several pairs of views."""

    def __init__(self, pairs: PointPairs, unit: float, limit: float, usable: Mask | None) -> None:
        super().__init__(limit, usable)
        self._pairs, self._unit = pairs, unit

    def residuals(self, points: list[Lines]) -> LinearPoints:
        """Return residuals and derivatives at each pair's (φ, θ, λ)."""
        return self._pairs.linearised(points, self._unit)

    def solve(self, normal: Normal, damping: float) -> tuple[Delta, float]:
        """Return the step, and −gᵀ δ (see the base)."""
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

    def moved(self, point: Lines, step: Delta, part: float) -> Lines:
        """Return (φ, θ, λ) after a part of a step."""
        return (
            point[0] + part * step[0],
            point[1] + part * step[1],
            point[2] + part * step[2],
        )


def _directed(
    pairs: PointPairs, starts: Sequence[Lines], sigma: float, usable: Mask | None
) -> tuple[list[Lines], Mask | None]:
    """Return each start in the sense that puts the points in front of the views, and who agrees.

    None stands for all. A feature agrees when its parallax is one that a point of the scene can
    have. An outlier that happens to lie near its epipolar plane passes the residual test, and
    with a short baseline its huge parallax would outweigh all others.
    """
    parallax = pairs.parallax(starts)
    # Far points vote with less weight, gross errors with no more than a good point.
    votes = np.tanh(parallax * (1.0 / (_FULL_VOTE_SIGMAS * sigma)))
    if usable is not None:
        votes *= usable
    sums = votes.reshape(pairs.pairs, -1).sum(axis=1).tolist()
    (usual,) = medians(np.abs(parallax)[None], pairs.pairs, usable)
    behind = _BEHIND_SIGMAS * sigma
    bounds, directed = [], []
    for start, vote, value in zip(starts, sums, usual, strict=True):
        nearest = max(_NEAREST * value, behind)
        bounds.append((-behind, nearest) if vote >= 0.0 else (-nearest, behind))
        turn = 0.0 if vote >= 0.0 else math.pi
        directed.append((start[0], wrapped(start[1] + turn), start[2]))
    low, high = np.array(bounds).T[:, :, None]
    shown = parallax.reshape(pairs.pairs, -1)
    plausible = ((shown > low) & (shown < high)).ravel()
    if usable is not None:
        plausible &= usable
    return directed, some(plausible)


def _judged(
    pairs: PointPairs,
    ends: Sequence[Lines],
    settled: Settled[LinearPoints],
    limit: float,
    sigma: float,
) -> list[LinesFit]:
    """Return the fits at (φ, θ, λ), what they are known by and what is not determined."""
    linear, weights, inside = settled
    unit = KERNEL_SIGMAS * sigma
    gradient2 = linear.gradient2
    shown = np.array([np.abs(linear.residual), pairs.trace / gradient2])
    inliers = shown[0] < limit / unit
    if inside is not None:
        inliers &= inside
    misfit, usual = medians(shown, pairs.pairs, some(inliers))
    metrics = [_Metric.of(scale) for _, _, scale in ends]
    # Residuals larger than promised widen the covariance; smaller ones do not narrow it. None
    # exceed the limit but for the median of no inliers at all, which is infinite.
    units = [max(1.0 / KERNEL_SIGMAS, MAD_TO_SD * min(size, 1.0 / unit)) ** 2 for size in misfit]
    # Features close to both the baseline and the horizon have rows of nothing but noise, which is
    # the trace over m's own noise, less 1 for that.
    loud = [
        _MAX_NOISE * value - (_MAX_NOISE - 1.0) * metric.a**2
        for value, metric in zip(usual, metrics, strict=True)
    ]
    quiet = shown[1].reshape(pairs.pairs, -1) < np.array(loud)[:, None]
    weights = weights * (inliers & quiet.ravel())
    sums = products(linear.jacobian * weights, linear.jacobian, pairs.pairs)
    information = np.array([m.scaled(s) for m, s in zip(metrics, sums, strict=True)])
    values, turns = np.linalg.eigh(information)
    axes = turns.swapaxes(1, 2).tolist()
    noise = linear.noise() * (weights / gradient2)
    forms = np.array([m.forms(a) for m, a in zip(metrics, axes, strict=True)])
    share = forms @ noise.reshape(6, pairs.pairs, -1).sum(axis=2).T[:, :, None]
    gram = np.array(products(noise, noise, pairs.pairs))
    doubt = np.sqrt(np.maximum(((forms @ gram) * forms).sum(axis=2), 0.0))
    scale = np.array(units)[:, None]
    clear = values - scale * share[:, :, 0]
    determined = clear > (_SIGNIFICANCE * math.sqrt(2.0)) * scale * doubt
    # Of an undetermined direction of the unit vector m nothing is known.
    variances = np.where(determined, scale / np.where(determined, clear, 1.0), 1.0).tolist()
    moved = [True] * len(ends)
    if not determined[:, 0].all():
        (parallax,) = medians(np.abs(pairs.parallax(ends))[None], pairs.pairs, some(inliers))
        moved = [
            p > _MOVED_SIGMAS * unit * math.sqrt(u) for p, u in zip(parallax, units, strict=True)
        ]
    agreeing, known = inliers.reshape(pairs.pairs, -1), determined.tolist()
    fits = []
    for k, (phi, theta, ratio) in enumerate(ends):
        variance, var_b = metrics[k].bearings(axes[k], variances[k])
        degeneracy = _problem(known[k], max(variance[2], var_b), moved=moved[k])
        lines = (wrapped(phi), wrapped(theta), ratio)
        fits.append(LinesFit(lines, variance, agreeing[k], degeneracy))
    return fits


class _Metric(NamedTuple):
    """Lengths ρ_a and ρ_b of the two parts of the unit vector m."""

    a: float
    b: float

    @classmethod
    def of(cls, scale: float) -> _Metric:
        """Return them for λ."""
        ratio = math.exp(scale)
        a = 1.0 / math.hypot(1.0, ratio)
        return cls(a, a * ratio)

    def scaled(self, sums: list[list[float]]) -> list[list[float]]:
        """Return the information by (φ, θ, λ) as that along the three axes.

        Along them θ, α and λ move by 1/ρ_a, 1/ρ_b and −1/(ρ_a ρ_b); φ moves α only and θ both.
        """
        (pp, pt, pl), (_, tt, tl), (_, _, ll) = sums
        x, y, z = 1.0 / self.a, 1.0 / self.b, -1.0 / (self.a * self.b)
        ab, aa = pt - pp, tt - 2.0 * pt + pp
        return [
            [aa * x * x, ab * x * y, (tl - pl) * x * z],
            [ab * x * y, pp * y * y, pl * y * z],
            [(tl - pl) * x * z, pl * y * z, ll * z * z],
        ]

    def forms(self, axes: list[list[float]]) -> list[tuple[float, ...]]:
        """Return the noise of ∂r/∂m along axes by the products of `LinearPoints.noise`/g²."""
        a, b = self
        ratio2 = (b / a) ** 2
        return [
            (
                p * p / a**2,
                q * q / b**2,
                -2.0 * p * r * b / a**2,
                2.0 * q * r * a / b**2,
                r * r * ratio2,
                r * r / ratio2,
            )
            for p, q, r in axes
        ]

    def bearings(
        self, axes: list[list[float]], variances: list[float]
    ) -> tuple[tuple[float, float, float], float]:
        """Return the variances of φ, of both and of θ, and that of α, by those along axes."""
        pp = pt = tt = aa = 0.0
        for (p, q, _), variance in zip(axes, variances, strict=True):
            theta, alpha = p / self.a, q / self.b
            pp += variance * (alpha - theta) ** 2
            pt += variance * (alpha - theta) * theta
            tt += variance * theta * theta
            aa += variance * alpha * alpha
        return (pp, pt, tt), aa


def _problem(determined: list[bool], widest: float, *, moved: bool) -> Degeneracy | None:
    """Return what is not determined, if anything; ``widest`` is a variance (rad²)."""
    if not determined[1]:
        return Degeneracy.CLUSTERED
    if not determined[0] and moved:
        return Degeneracy.ONE_PLANE
    if not determined[0] or widest > _MAX_SD**2:
        return Degeneracy.SHORT_BASELINE
    return None
