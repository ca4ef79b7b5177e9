"""The planar epipolar residual of several pairs of views at once, and its robust minimum.

With the components of the rays across and along the baseline, which lies at the bearing θ in
view A and α = θ + φ in view B,

    a⊥ = a_x cos θ − a_y sin θ,   a∥ = a_x sin θ + a_y cos θ,   b⊥ and b∥ likewise with α,

the constraint aᵀ E b = 0 of `visctrl.geometry.two_view.planar` and its gradient by both rays are

    e = b_z a⊥ − a_z b⊥,   g² = a_z² + b_z² + a⊥² + b⊥²,   r = e/g  (Sampson),

    ∂e/∂(θ, α) = (−b_z a∥, a_z b∥),   ½ ∂g²/∂(θ, α) = −(a⊥ a∥, b⊥ b∥),
    ∂r/∂(θ, α) = (∂e/∂(θ, α) − (r/g) ½ ∂g²/∂(θ, α)) / g,

where φ moves α only and θ moves both.

All pairs are evaluated together; see `visctrl.geometry.robust.soft_l1`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
)
from visctrl.geometry.two_view.degeneracy import Degeneracy
from visctrl.geometry.two_view.level_pairs import Complex, LevelPairs
from visctrl.robots.unicycle import wrapped

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
#: (φ, θ) in rad.
Motion = tuple[float, float]

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


class MotionFit(NamedTuple):
    """The least residuals of one pair of views.

    phi, direction : φ and θ (rad); the baseline points to where most features are in front.
    variance : of φ, of both together and of θ (rad²); infinite where nothing was measured.
    inliers : (N,) features that agree.
    degeneracy : what is not determined, if anything.
    """

    phi: float
    direction: float
    variance: tuple[float, float, float]
    inliers: Mask
    degeneracy: Degeneracy | None


class LinearRays(NamedTuple):
    """P motions with their N features side by side.

    a, b : (P N,), the level parts of the rays about the baseline, a⊥ + i a∥ and b⊥ + i b∥.
    residual : (P N,), r in units of ``unit`` rad.
    jacobian : (2, P N), ∂r/∂(φ, θ).
    gradient2 : (P N,), g².
    """

    a: Complex
    b: Complex
    residual: Array
    jacobian: Array
    gradient2: Array


class RayPairs(LevelPairs):
    """Unit rays of features in pairs of views."""

    @classmethod
    def of(cls, rays_a: ArrayLike, rays_b: ArrayLike, motions: int = 1) -> RayPairs:
        """Return one pair of rays (N, 3), once for each of several motions."""
        a, b = np.asarray(rays_a, dtype=np.float64), np.asarray(rays_b, dtype=np.float64)
        return cls(np.array([a.T] * motions), b.T)

    def look(self, b: Array) -> None:
        """Put other rays in the place of view B's."""
        super().look(b)
        # Rays along the baseline and level with the camera have neither error nor gradient.
        self._up2 = self.a_up * self.a_up + self.b_up * self.b_up + 1e-18

    def linearised(self, motions: Sequence[Motion], unit: float | Array = 1.0) -> LinearRays:
        """Return residuals and derivatives at each pair's (φ, θ).

        unit : of the residuals (rad), of all or of each (P N,).
        """
        a, b = self.turned(motions)
        a_across, b_across = a.real, b.real
        error = self.b_up * a_across - self.a_up * b_across
        gradient2 = a_across * a_across + b_across * b_across
        gradient2 += self._up2
        inverse = 1.0 / gradient2
        scale = np.sqrt(inverse) * (1.0 / unit)
        pull = error * inverse
        by_theta = (pull * a_across - self.b_up) * a.imag
        by_alpha = (pull * b_across + self.a_up) * b.imag
        jacobian = np.empty((2, len(scale)))
        np.multiply(by_alpha, scale, out=jacobian[0])
        np.multiply(by_theta + by_alpha, scale, out=jacobian[1])
        return LinearRays(a, b, error * scale, jacobian, gradient2)

    def loudness(self, linear: LinearRays) -> Array:
        """Return 1 plus the variance (P N,) in σ² of ∂r/∂θ that pixel noise alone makes.

        That is (a_z² + b_z² + a∥² + b∥²)/g², and the rays are of unit length.
        """
        return np.asarray((self._up2 + 2.0) / linear.gradient2)

    def votes(self, linear: LinearRays, sigma: float | Array) -> Array:
        """Return each feature's vote (P N,) on the sense of its baseline.

        sigma : of a ray's direction (rad), of all or of each (P N,).

        Far points have less weight, gross errors no more than a good point.
        """
        front = self.front(linear.a, linear.b)
        return np.asarray(np.tanh(front * (1.0 / (_FULL_VOTE_SIGMAS * sigma))))


def fit(
    pairs: RayPairs,
    starts: Sequence[Motion],
    sigma: float | Array,
    *,
    limit_sigmas: float = math.inf,
    present: Mask | None = None,
    iterations: int = 15,
) -> list[MotionFit]:
    """Return the soft-L1 minimum of each pair's residuals near a start.

    Parameters
    ----------
    pairs : RayPairs
    starts : (φ, θ) in rad, one a pair
        The sense of the direction is found anew.
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
    if isinstance(sigma, np.ndarray):
        sigma = np.repeat(sigma, pairs.features)
    unit = KERNEL_SIGMAS * sigma

    usable = None if present is None else present.ravel()
    problem = _MotionProblem(pairs, unit, limit_sigmas / KERNEL_SIGMAS, usable)
    found = levenberg_marquardt(problem, starts, options(iterations, _LONGEST_STEP))
    return _judged(pairs, found.points, found.linear, sigma)


class _MotionProblem(SoftL1Problem[Motion, LinearRays]):
    """Motions (φ, θ) of several pairs of views."""

    def __init__(
        self, pairs: RayPairs, unit: float | Array, limit: float, usable: Mask | None
    ) -> None:
        super().__init__(limit, usable)
        self._pairs, self._unit = pairs, unit

    def residuals(self, points: list[Motion]) -> LinearRays:
        """Return residuals and derivatives at each pair's (φ, θ)."""
        return self._pairs.linearised(points, self._unit)

    def solve(self, normal: Normal, damping: float) -> tuple[Delta, float]:
        """Return the step of (φ, θ), and −gᵀ δ (see the base)."""
        (pp, pt), (_, tt), (g_p, g_t) = normal
        pp, tt = pp * (1.0 + damping) + 1e-12, tt * (1.0 + damping) + 1e-12
        # Rounding must not make it nothing where the features say the same.
        det = max(pp * tt - pt * pt, 1e-24)
        phi, theta = (pt * g_t - tt * g_p) / det, (pt * g_p - pp * g_t) / det
        return (phi, theta), -(phi * g_p + theta * g_t)

    def moved(self, point: Motion, step: Delta, part: float) -> Motion:
        """Return (φ, θ) after a part of a step."""
        return point[0] + part * step[0], point[1] + part * step[1]


def _judged(
    pairs: RayPairs,
    motions: Sequence[Motion],
    settled: Settled[LinearRays],
    sigma: float | Array,
) -> list[MotionFit]:
    """Return the fits at (φ, θ), what they are known by and what is not determined."""
    linear, weights, inside = settled
    by_phi, by_theta = linear.jacobian
    shown = np.empty((2, len(weights)))
    np.abs(linear.residual, out=shown[0])
    loudness = shown[1] = pairs.loudness(linear)
    misfit, usual = medians(shown, pairs.pairs, inside)
    # Residuals larger than promised widen the covariance; smaller ones do not narrow it.
    units = [max(1.0 / KERNEL_SIGMAS, MAD_TO_SD * size) for size in misfit]
    loud = [1.0 + max(_MAX_NOISE, _USUAL_NOISE * (value - 1.0)) for value in usual]
    limits = np.array([[3.0 * unit for unit in units], loud])[:, :, None]
    agree, quiet = shown.reshape(2, pairs.pairs, -1) < limits
    if inside is not None:
        agree &= inside.reshape(agree.shape)
    # Sums over the features, weighted in three ways, of products of the derivatives and the noise.
    rows, columns = np.empty((3, len(weights))), np.empty((6, len(weights)))
    rows[0] = weights
    np.divide(weights, loudness, out=rows[1])
    np.multiply(weights, quiet.ravel(), out=rows[2])
    np.multiply(by_phi, by_phi, out=columns[0])
    np.multiply(by_phi, by_theta, out=columns[1])
    np.multiply(by_theta, by_theta, out=columns[2])
    noise = np.subtract(loudness, 1.0, out=columns[3])
    noise2 = noise * noise
    np.multiply(noise2, rows[0], out=columns[4])
    np.multiply(noise2, rows[1], out=columns[5])
    sums = products(rows, columns, pairs.pairs)
    votes = pairs.votes(linear, sigma)
    if inside is not None:
        votes *= inside
    sense = votes.reshape(pairs.pairs, -1).sum(axis=1).tolist()
    fits = []
    for k, (phi, theta) in enumerate(motions):
        variance, degeneracy = _variance(sums[k], units[k] ** 2)
        direction = theta if sense[k] >= 0.0 else theta + math.pi
        fits.append(MotionFit(wrapped(phi), wrapped(direction), variance, agree[k], degeneracy))
    return fits


def _variance(
    sums: list[list[float]], unit: float
) -> tuple[tuple[float, float, float], Degeneracy | None]:
    """Return the variances of φ, of both and of θ, and the degeneracy, if any.

    With a short baseline the noise itself makes the θ column non-zero; its share is taken out
    of the information, or the direction would look known when it is not. Rays along the
    baseline and level with the camera have a column of mostly noise, for a perspective camera
    that drives ahead nearly all of them: each counts in the test by how little of it is.

    Parameters
    ----------
    sums : three rows, of all features, of all by how little noise they have, of the quiet ones
        Weighted sums of (∂r/∂φ)², ∂r/∂φ ∂r/∂θ, (∂r/∂θ)², the noise of ∂r/∂θ and, in the first
        two rows and the last two columns, of its weighted square.
    unit : variance of a residual, in the residuals' own unit.
    """
    (pp, pt, tt, noise, doubt2, _), (_, _, shown, shown_noise, _, shown2), quiet = sums
    if pp * _MAX_PHI_SD**2 < unit:
        return (math.inf, 0.0, math.inf), Degeneracy.CLUSTERED_OR_LEVEL
    doubt, doubt_shown = math.sqrt(2.0 * doubt2), math.sqrt(2.0 * shown2)
    signal = shown / unit - shown_noise
    alone = unit / pp
    if signal < _BASELINE_SIGNIFICANCE * max(doubt_shown, 1e-12):
        return (alone, 0.0, _UNKNOWN_DIRECTION), Degeneracy.IDENTICAL
    known = max(quiet[2] / unit - quiet[3], tt / unit - noise - 2.0 * doubt)
    coupling = pt / pp
    direction = 1.0 / max(known - coupling * pt / unit, 1e-12)
    variance = (alone + coupling**2 * direction, -coupling * direction, direction)
    if variance[0] > _MAX_PHI_SD**2 or direction > _MAX_DIRECTION_SD**2:
        return variance, Degeneracy.CLUSTERED
    return variance, None
