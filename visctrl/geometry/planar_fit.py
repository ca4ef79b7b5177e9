"""The planar epipolar residual of several pairs of views at once, and its robust minimum.

With the components of the rays across and along the baseline, which lies at the bearing θ in
view A and α = θ + φ in view B,

    a⊥ = a_x cos θ − a_y sin θ,   a∥ = a_x sin θ + a_y cos θ,   b⊥ and b∥ likewise with α,

the constraint aᵀ E b = 0 of `visctrl.geometry.planar` and its gradient by both rays are

    e = b_z a⊥ − a_z b⊥,   g² = a_z² + b_z² + a⊥² + b⊥²,   r = e/g  (Sampson),

    ∂e/∂(θ, α) = (−b_z a∥, a_z b∥),   ½ ∂g²/∂(θ, α) = −(a⊥ a∥, b⊥ b∥),
    ∂r/∂(θ, α) = (∂e/∂(θ, α) − (r/g) ½ ∂g²/∂(θ, α)) / g,

where φ moves α only and θ moves both.

All pairs are evaluated together; see `visctrl.geometry.robust_fit`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robots.unicycle import wrapped
from visctrl.geometry.robust_fit import (
    Delta,
    Descent,
    Normal,
    Settled,
    medians,
    products,
    settle,
    side_by_side,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
#: (φ, θ) in rad.
Motion = tuple[float, float]

#: Why a motion is degenerate: the baseline does not stand out of the noise.
IDENTICAL = "views identical: the direction of the baseline is not determined"
#: A baseline shows when its information exceeds the noise's by this many standard deviations.
_BASELINE_SIGNIFICANCE = 5.0
#: Noise of the θ column (in σ²) up to which a feature always says something about the direction,
#: and the multiple of the usual noise up to which it does where all have more.
_MAX_NOISE, _USUAL_NOISE = 4.0, 10.0
#: Standard deviations (rad) beyond which a motion counts as undetermined.
_MAX_PHI_SD, _MAX_DIRECTION_SD = 0.2, 0.5
#: Variance of a direction of which nothing is known (uniform on the circle).
_UNKNOWN_DIRECTION = math.pi**2 / 3.0
#: Parallax (in σ) from which a feature has a full vote on the sense of the baseline.
_FULL_VOTE_SIGMAS = 3.0
#: Longest step (rad): a direction without information must not jump round the circle.
_LONGEST_STEP = 0.5


class Fit(NamedTuple):
    """The least residuals of one pair of views.

    phi, direction : φ and θ (rad); the baseline points to where most features are in front.
    variance : of φ, of both together and of θ (rad²); infinite where nothing was measured.
    inliers : (N,) features that agree.
    reason : what is not determined, if anything.
    """

    phi: float
    direction: float
    variance: tuple[float, float, float]
    inliers: Mask
    reason: str


class Linearised(NamedTuple):
    """P motions with their N features side by side.

    parts : (4, P N), a⊥, a∥, b⊥ and b∥.
    residual : (P N,), r in rad.
    jacobian : (2, P N), ∂r/∂(φ, θ).
    gradient2 : (P N,), g².
    """

    parts: Array
    residual: Array
    jacobian: Array
    gradient2: Array


class RayPairs:
    """Unit rays of N features in P pairs of views (A, B).

    Parameters
    ----------
    a, b : sequences of P arrays (3, N)
        Rays (right, forward, up). A view that several pairs share, or a pair of which several
        motions are asked for, is repeated.
    """

    def __init__(self, a: Sequence[Array], b: Sequence[Array]) -> None:
        self.features = a[0].shape[1]
        blocks = []
        lifts = np.empty((2, len(a), self.features))
        for p, (view_a, view_b) in enumerate(zip(a, b, strict=True)):
            blocks.append(np.concatenate([view_a[:2], view_b[:2]]))
            lifts[0, p], lifts[1, p] = view_a[2], view_b[2]
        self._level = side_by_side(blocks)
        self._a_up, self._b_up = lifts.reshape(2, -1)
        self._heights = self._a_up + self._b_up
        # Rays along the baseline and level with the camera have neither error nor gradient.
        self._up2 = self._a_up * self._a_up + self._b_up * self._b_up + 1e-18

    @classmethod
    def of(cls, rays_a: ArrayLike, rays_b: ArrayLike, motions: int = 1) -> RayPairs:
        """Return one pair of rays (N, 3), for one motion or several."""
        a, b = np.asarray(rays_a, dtype=np.float64), np.asarray(rays_b, dtype=np.float64)
        return cls([a.T] * motions, [b.T] * motions)

    def linearised(self, motions: Sequence[Motion]) -> Linearised:
        """Return residuals and derivatives at each pair's (φ, θ) in rad."""
        turns: tuple[list[float], ...] = ([], [], [], [])
        for phi, theta in motions:
            s, c, alpha = math.sin(theta), math.cos(theta), theta + phi
            s_b, c_b = math.sin(alpha), math.cos(alpha)
            turns[0].extend((c, -s, 0.0, 0.0))
            turns[1].extend((s, c, 0.0, 0.0))
            turns[2].extend((0.0, 0.0, c_b, -s_b))
            turns[3].extend((0.0, 0.0, s_b, c_b))
        parts = np.array(turns).dot(self._level)
        a_across, a_along, b_across, b_along = parts
        error = self._b_up * a_across - self._a_up * b_across
        gradient2 = a_across * a_across + b_across * b_across
        gradient2 += self._up2
        scale = 1.0 / np.sqrt(gradient2)
        residual = error * scale
        pull = residual * scale
        by_theta = (pull * a_across - self._b_up) * a_along
        by_alpha = (pull * b_across + self._a_up) * b_along
        jacobian = np.empty((2, len(scale)))
        np.multiply(by_alpha, scale, out=jacobian[0])
        np.multiply(by_theta + by_alpha, scale, out=jacobian[1])
        return Linearised(parts, residual, jacobian, gradient2)

    def loudness(self, linear: Linearised) -> Array:
        """Return 1 plus the variance (P N,) in σ² of ∂r/∂θ that pixel noise alone makes.

        That is (a_z² + b_z² + a∥² + b∥²)/g², and the rays are of unit length.
        """
        return np.asarray((self._up2 + 2.0) / linear.gradient2)

    def votes(self, parts: Array, sigma: float, inside: Mask | None) -> Array:
        """Return the votes (P N,) of features ``inside`` on the sense of the baselines.

        A feature votes with the sine of its parallax times the sum of both rays' sines from the
        baseline, positive where they meet in front of the views; far points have less weight,
        gross errors no more than a good point.
        """
        a_across, a_along, b_across, b_along = parts
        level = a_along * b_across - a_across * b_along
        upright = self._b_up * a_along - self._a_up * b_along
        front = level * (a_across + b_across) + upright * self._heights
        votes = np.tanh(front * (1.0 / max(_FULL_VOTE_SIGMAS * sigma, 1e-12)))
        return np.asarray(votes if inside is None else votes * inside)


def fit(
    pairs: RayPairs,
    starts: Sequence[Motion],
    sigma: float,
    *,
    limit: float = math.inf,
    present: Mask | None = None,
    iterations: int = 15,
) -> list[Fit]:
    """Return the soft-L1 minimum of each pair's residuals near a start.

    Parameters
    ----------
    pairs : RayPairs
    starts : (φ, θ) in rad, one a pair
        The sense of the direction is found anew.
    sigma : float
        Standard deviation of one ray's direction (rad).
    limit : float
        Features with larger residuals (rad) do not count, while most have smaller ones.
    present : (P, N) array or None
        Features that a pair has at all; None for all.
    iterations : int
        At most this many steps.
    """
    descents = [_Motion(start, iterations, _LONGEST_STEP) for start in starts]
    usable = None if present is None else present.ravel()
    settled = settle(pairs.linearised, descents, sigma, limit=limit, usable=usable)
    return _judged(pairs, [descent.ahead for descent in descents], settled, sigma)


class _Motion(Descent[Motion]):
    """Descent of one pair's (φ, θ)."""

    def solve(self, normal: Normal, damping: float) -> tuple[Delta, float]:
        """Return the step of (φ, θ), and −gᵀ δ (see the base)."""
        (pp, pt), (_, tt), (g_p, g_t) = normal
        pp, tt = pp * (1.0 + damping) + 1e-12, tt * (1.0 + damping) + 1e-12
        det = pp * tt - pt * pt
        phi, theta = (pt * g_t - tt * g_p) / det, (pt * g_p - pp * g_t) / det
        return (phi, theta), -(phi * g_p + theta * g_t)

    def moved(self, point: Motion, delta: Delta, part: float) -> Motion:
        """Return (φ, θ) after a part of a step."""
        return point[0] + part * delta[0], point[1] + part * delta[1]


def _judged(
    pairs: RayPairs, motions: Sequence[Motion], settled: Settled[Linearised], sigma: float
) -> list[Fit]:
    """Return the fits at (φ, θ), what they are known by and what is not determined."""
    (linear, weights, inside), problems = settled, len(motions)
    by_phi, by_theta = linear.jacobian
    shown = np.array([np.abs(linear.residual), pairs.loudness(linear)])
    loudness = shown[1]
    misfit, usual = medians(shown, problems, inside)
    # Residuals larger than promised widen the covariance; smaller ones do not narrow it.
    units = [max(sigma, 1.4826 * size) for size in misfit]
    loud = [1.0 + max(_MAX_NOISE, _USUAL_NOISE * (value - 1.0)) for value in usual]
    limits = np.array([[3.0 * unit for unit in units], loud])
    agree, quiet = shown < np.repeat(limits, pairs.features, axis=1)
    if inside is not None:
        agree &= inside
    # Sums over the features, weighted in three ways, of four products.
    rows, columns = np.empty((3, len(weights))), np.empty((4, len(weights)))
    rows[0] = weights
    np.divide(weights, loudness, out=rows[1])
    np.multiply(weights, quiet, out=rows[2])
    np.multiply(by_phi, by_phi, out=columns[0])
    np.multiply(by_phi, by_theta, out=columns[1])
    np.multiply(by_theta, by_theta, out=columns[2])
    np.subtract(loudness, 1.0, out=columns[3])
    sums = products(rows, columns, problems)
    noise = rows[:2] * columns[3]
    squares = products(noise, noise, problems)
    votes = pairs.votes(linear.parts, sigma, inside).reshape(problems, -1).sum(axis=1).tolist()
    agreeing = agree.reshape(problems, -1)
    fits = []
    for k, (phi, theta) in enumerate(motions):
        variance, reason = _variance(sums[k], squares[k], units[k] ** 2)
        direction = theta if votes[k] >= 0.0 else theta + math.pi
        fits.append(Fit(wrapped(phi), wrapped(direction), variance, agreeing[k], reason))
    return fits


def _variance(
    sums: list[list[float]], squares: list[list[float]], unit: float
) -> tuple[tuple[float, float, float], str]:
    """Return the variances of φ, of both and of θ, and the name of the degeneracy, if any.

    With a short baseline the noise itself makes the θ column non-zero; its share is taken out
    of the information, or the direction would look known when it is not. Rays along the
    baseline and level with the camera have a column of mostly noise, for a perspective camera
    that drives ahead nearly all of them: each counts in the test by how little of it is.

    Parameters
    ----------
    sums : three rows, of all features, of all by how little noise they have, of the quiet ones
        Weighted sums of (∂r/∂φ)², ∂r/∂φ ∂r/∂θ, (∂r/∂θ)² and the noise of ∂r/∂θ (σ²).
    squares : sums of the products of the weighted noise, of the first two rows.
    unit : variance of one residual (rad²).
    """
    (pp, pt, tt, noise), (_, _, shown, shown_noise), (_, _, quiet, quiet_noise) = sums
    if pp * _MAX_PHI_SD**2 < unit:
        return (math.inf, 0.0, math.inf), "features clustered, or level with the camera"
    doubt, doubt_shown = math.sqrt(2.0 * squares[0][0]), math.sqrt(2.0 * squares[1][1])
    signal = shown / unit - shown_noise
    alone = unit / pp
    if signal < _BASELINE_SIGNIFICANCE * max(doubt_shown, 1e-12):
        return (alone, 0.0, _UNKNOWN_DIRECTION), IDENTICAL
    known = max(quiet / unit - quiet_noise, tt / unit - noise - 2.0 * doubt)
    coupling = pt / pp
    direction = 1.0 / max(known - coupling * pt / unit, 1e-12)
    variance = (alone + coupling**2 * direction, -coupling * direction, direction)
    if variance[0] > _MAX_PHI_SD**2 or direction > _MAX_DIRECTION_SD**2:
        return variance, "features clustered: they do not separate turning from moving"
    return variance, ""
