"""The planar motions between many pairs of views: `visctrl.geometry.planar` in arrays.

R pairs of views with N features, some of them not shared. The equations and constants are those
of the single search, which is also what these functions are tested against.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from robots.unicycle import wrap_angle
from visctrl.geometry.parallax import meeting
from visctrl.geometry.planar import (
    BASELINE_SIGNIFICANCE,
    KERNEL_SIGMAS,
    MAX_DIRECTION_SD,
    MAX_NOISE,
    MAX_PHI_SD,
    MINIMUM_FEATURES,
    NEAR,
    NEAREST,
    STILL,
    USUAL_NOISE,
    two_point_motions,
)
from visctrl.geometry.trifocal_solvers import NOISE_MEDIAN, NOISE_MEDIAN_SD, SIGNIFICANCE
from visctrl.montecarlo.robots import Array, Index, Mask, Parts, Robots

#: Features on which every hypothesis is judged before the promising ones are on all.
_FIRST = 12
#: Robots whose hypotheses are judged at once: they fit in a processor's cache.
_AT_ONCE = 16


class Motions(NamedTuple):
    """Planar motions of R pairs of views: see `visctrl.geometry.planar.PlanarMotion`.

    phi, direction (R,), covariance (R, 2, 2), of both. sound (R,): health is OK.
    """

    phi: Array
    direction: Array
    covariance: Array
    sound: Mask


class Rays(Robots):
    """R pairs of views A and B.

    Parameters
    ----------
    a, b : Parts
        Unit rays of the same features in both views; finite where they are not shared, too.
    shared : (R, N) array
        1 where both views show a feature, else 0.
    sigma : (R,) array
        Standard deviation of a ray's direction (rad).
    """

    def __init__(self, a: Parts, b: Parts, shared: Array, sigma: Array) -> None:
        self.a, self.b, self.shared, self.sigma = a, b, shared, sigma

    def only(self, which: Mask) -> Rays:
        """Return the same views with only some of the features shared."""
        kept = copy.copy(self)
        kept.shared = np.where(which, self.shared, 0.0)
        return kept

    def parallax(self, phi: Array, direction: Array) -> Array:
        """Return signed parallaxes (R, N): see `visctrl.geometry.parallax.signed_parallax`."""
        return meeting(_along(self.a, direction), _along(self.b, direction + phi))

    def towards_points(self, phi: Array, direction: Array) -> Array:
        """Return directions or their opposites: those that put points in front of both views."""
        unit = np.maximum(3.0 * self.sigma, 1e-12)[:, None]
        votes = np.tanh(self.parallax(phi, direction) / unit) * self.shared
        return wrap_angle(direction + np.where(votes.sum(axis=1) >= 0.0, 0.0, np.pi))

    def plausible(self, phi: Array, direction: Array, limit: Array) -> Mask:
        """Return whether each parallax is one that a point of the scene can have."""
        parallax = self.parallax(phi, direction)
        usual = median(np.abs(parallax), self.shared)[:, None]
        limit = 2.0 * limit[:, None]
        return np.asarray((parallax > -limit) & (parallax < np.maximum(NEAREST * usual, limit)))


class _Linearised(NamedTuple):
    """Sampson residuals (R, N) in rad, their derivatives by φ and θ, and the latter's noise."""

    residual: Array
    by_phi: Array
    by_theta: Array
    noise: Array


def identical(views: Rays) -> Mask:
    """Return whether views differ by a turn at most: see `trifocal_solvers.identical_views`."""
    (a0, a1, _), (b0, b1, _) = views.a, views.b
    level = np.minimum(np.hypot(a0, a1), np.hypot(b0, b1))
    turn = np.arctan2(b0 * a1 - b1 * a0, b1 * a1 + b0 * a0)
    sine, cosine = np.sin(turn) * views.shared, np.cos(turn) * views.shared
    centre = np.arctan2(sine.sum(axis=1), cosine.sum(axis=1))[:, None]
    deviation = median(np.abs(np.sin(turn - centre)) * level, views.shared)
    count = np.maximum(views.shared.sum(axis=1), 1.0)
    bound = NOISE_MEDIAN + SIGNIFICANCE * NOISE_MEDIAN_SD / np.sqrt(count)
    return np.asarray(deviation < bound * views.sigma)


def search(views: Rays, seeds: Sequence[int], threshold_sigmas: float, hypotheses: int) -> Motions:
    """Return the motions that most features agree with: see `ransac_planar_motion`."""
    limit = threshold_sigmas * views.sigma
    phi, direction, near = _best_hypotheses(views, seeds, limit, hypotheses)
    direction = views.towards_points(phi, direction)
    inliers = near & views.plausible(phi, direction, limit)
    enough = np.ones(len(phi), dtype=np.bool_)
    for _ in range(2):
        agreeing = views.only(inliers)
        enough &= agreeing.shared.sum(axis=1) >= MINIMUM_FEATURES
        motions = refine(agreeing, phi, direction)
        phi, direction = motions.phi, motions.direction
        residual = linearise(views, phi, direction).residual
        inliers = np.abs(residual) < limit[:, None]
        inliers &= views.plausible(phi, direction, limit)
    return motions._replace(sound=motions.sound & enough)


def _best_hypotheses(
    views: Rays, seeds: Sequence[int], limit: Array, count: int
) -> tuple[Array, Array, Mask]:
    """Return the motions of the best samples, and which features (R, N) are near to them."""
    a, b = np.stack(views.a, axis=2), np.stack(views.b, axis=2)
    # The shared features first; those behind count for nothing.
    order = np.argsort(views.shared == 0.0, axis=1, kind="stable")
    sizes = views.shared.sum(axis=1).astype(np.intp).tolist()
    phi, theta = np.zeros(len(a)), np.zeros(len(a))
    near = np.zeros(order.shape, dtype=np.bool_)
    for first in range(0, len(a), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        robots = np.arange(len(a))[some, None]
        samples = [_sample(*each, count) for each in zip(seeds[some], sizes[some], strict=True)]
        chosen = order[robots[..., None], np.stack(samples)]
        motions = _hypotheses(a[robots[..., None], chosen], b[robots[..., None], chosen])
        ordered = a[robots, order[some]], b[robots, order[some]]
        scores = _Scores(*ordered, *motions, limit[some])
        for k, size in enumerate(sizes[some]):
            best, close = scores.best(k, size)
            theta[first + k] = motions[0][k, best]
            phi[first + k] = motions[1][k, best] - motions[0][k, best]
            near[first + k, order[first + k, :size]] = close
    return phi, theta, near


def _hypotheses(a: Array, b: Array) -> tuple[Array, Array]:
    """Return (θ, α) (R, 2H) of the motions through samples (R, H, 2, 3)."""
    shape = (2, *a.shape[:2])
    motions = two_point_motions(a.reshape(-1, 2, 3), b.reshape(-1, 2, 3))
    theta, alpha = (np.concatenate(tuple(each.reshape(shape)), axis=1) for each in motions)
    return theta, alpha


def _sample(seed: int, size: int, count: int) -> Index:
    """Return the numbers (count, 2) of two different features each, as the single search does."""
    if size < MINIMUM_FEATURES:
        return np.zeros((count, 2), dtype=np.intp)
    rng = np.random.default_rng(seed)
    first = rng.integers(0, size, count)
    return np.stack([first, (first + rng.integers(1, size, count)) % size], axis=-1)


class _Scores:
    """Truncated sums of squared Sampson residuals of H motions (R, H) for each pair of views.

    With A = cos θ a_0 − sin θ a_1 and B = sin α b_1 − cos α b_0 the residual is b_2 A + a_2 B
    over the root of a_2² + b_2² + A² + B². Both are linear in the sines and cosines of the
    angles and of their doubles, so all residuals come out of two products of matrices.

    Parameters
    ----------
    a, b : (R, N, 3) arrays
        Unit rays.
    theta, alpha : (R, H) arrays
        The motions: see `visctrl.geometry.planar`.
    limit : (R,) array
        Where a residual counts as an outlier's (rad).
    """

    def __init__(self, a: Array, b: Array, theta: Array, alpha: Array, limit: Array) -> None:
        st, ct, sa, ca = np.sin(theta), np.cos(theta), np.sin(alpha), np.cos(alpha)
        one = np.ones_like(st)
        doubles = one, ct * ct - st * st, 2.0 * st * ct, ca * ca - sa * sa, 2.0 * sa * ca
        self._by_error, self._by_square = np.stack([ct, st, sa, ca], 2), np.stack(doubles, 2)
        (a0, a1, a2), (b0, b1, b2) = np.moveaxis(a, 2, 0), np.moveaxis(b, 2, 0)
        self._error = np.stack([b2 * a0, -b2 * a1, a2 * b1, -a2 * b0], axis=1)
        level = 0.5 * (a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1)
        halves = 0.5 * (a0 * a0 - a1 * a1), -a0 * a1, 0.5 * (b0 * b0 - b1 * b1), -b0 * b1
        self._square = np.stack([a2 * a2 + b2 * b2 + level, *halves], axis=1)
        self._limit2 = limit**2
        few = slice(None), slice(None), slice(_FIRST)
        squared = _quotient(self._by_error @ self._error[few], self._by_square @ self._square[few])
        self._bounds = np.minimum(squared, self._limit2[:, None, None]).sum(axis=2)

    def best(self, robot: int, size: int) -> tuple[int, Mask]:
        """Return which motion explains one robot's features best, and which of these it does.

        size : how many of the features count, at least `MINIMUM_FEATURES`.

        The sum over a few features is a lower bound of that over all: motions whose bound is
        above the sum of the most promising one cannot be the best.
        """
        if size < MINIMUM_FEATURES:
            return 0, np.zeros(size, dtype=np.bool_)
        if size < _FIRST:
            left = np.arange(len(self._bounds[robot]))
        else:
            bounds = self._bounds[robot]
            first = np.array([np.argmin(bounds)])
            least = self._sums(self._squared(robot, size, first), robot)
            # Sums in another order may differ in the last digit.
            left = np.flatnonzero(bounds <= least * (1.0 + 1e-9))
        squared = self._squared(robot, size, left)
        best = int(np.argmin(self._sums(squared, robot)))
        return int(left[best]), squared[best] < self._limit2[robot]

    def _squared(self, robot: int, size: int, which: Index) -> Array:
        return _quotient(
            self._by_error[robot, which] @ self._error[robot, :, :size],
            self._by_square[robot, which] @ self._square[robot, :, :size],
        )

    def _sums(self, squared: Array, robot: int) -> Array:
        return np.asarray(np.minimum(squared, self._limit2[robot]).sum(axis=1))


def _quotient(error: Array, square: Array) -> Array:
    error *= error
    error /= np.maximum(square, 1e-18)
    return error


def refine(views: Rays, phi: Array, direction: Array, iterations: int = 15) -> Motions:
    """Return motions refined from a start: see `visctrl.geometry.planar.refine_planar_motion`."""
    phi, direction = _descend(views, phi, direction, iterations)
    linear = linearise(views, phi, direction)
    scaled = linear.residual / views.sigma[:, None]
    weights = _soft_l1_weights(scaled) * views.shared
    spread = np.maximum(1.0, 1.4826 * median(np.abs(scaled), views.shared))
    covariance, sound = _covariance(linear, weights, (views.sigma * spread) ** 2, views.shared)
    return Motions(wrap_angle(phi), views.towards_points(phi, direction), covariance, sound)


def linearise(views: Rays, phi: Array, direction: Array) -> _Linearised:
    """Return the residuals of motions (R,) and what they depend on."""
    (a0, a1, a2), (b0, b1, b2) = views.a, views.b
    theta, alpha = direction[:, None], (direction + phi)[:, None]
    st, ct, sa, ca = np.sin(theta), np.cos(theta), np.sin(alpha), np.cos(alpha)
    A, dA = ct * a0 - st * a1, -st * a0 - ct * a1
    B, dB = sa * b1 - ca * b0, sa * b0 + ca * b1
    up = a2 * a2 + b2 * b2
    inverse2 = 1.0 / np.maximum(up + A * A + B * B, 1e-18)
    inverse = np.sqrt(inverse2)
    residual = (b2 * A + a2 * B) * inverse
    by_theta = (b2 - residual * A * inverse) * dA * inverse
    by_alpha = (a2 - residual * B * inverse) * dB * inverse
    noise = (up + dA * dA + dB * dB) * inverse2
    return _Linearised(residual, by_alpha, by_theta + by_alpha, noise)


def _descend(views: Rays, phi: Array, direction: Array, iterations: int) -> tuple[Array, Array]:
    """Return the (φ, θ) that Levenberg–Marquardt reaches; every robot stops where it would."""
    found = np.stack([phi, direction], axis=1)
    index: Index = np.arange(len(phi))
    here, linear = found, linearise(views, phi, direction)
    cost = _cost(linear, views)
    damping, newton = np.full(len(phi), 1e-3), np.zeros(len(phi), dtype=np.bool_)
    for _ in range(iterations):
        step = _step(linear, views, damping, newton)
        longest = np.abs(step).max(axis=1)
        # A direction without information must not jump round the circle.
        ahead = here + np.minimum(1.0, 0.5 / np.maximum(longest, 1e-12))[:, None] * step
        trial = linearise(views, *ahead.T)
        trial_cost = _cost(trial, views)
        better = ~(trial_cost > cost)
        pairs = zip(trial, linear, strict=True)
        linear = _Linearised(*(np.where(better[:, None], new, old) for new, old in pairs))
        here = np.where(better[:, None], ahead, here)
        cost = np.where(better, trial_cost, cost)
        damping = np.where(better, damping * 0.1, np.maximum(damping, 1e-6) * 10.0)
        newton = better & (longest < NEAR * views.sigma)
        found[index] = here
        on = np.flatnonzero(longest >= STILL * views.sigma)
        if not len(on):
            break
        if len(on) < len(index):
            index, views, here, cost = index[on], views.take(on), here[on], cost[on]
            linear = _Linearised(*(each[on] for each in linear))
            damping, newton = damping[on], newton[on]
    return found[:, 0], found[:, 1]


def _step(linear: _Linearised, views: Rays, damping: Array, newton: Mask) -> Array:
    """Return the damped steps (R, 2) of (φ, θ): see `visctrl.geometry.planar._step`."""
    weights = _soft_l1_weights(linear.residual / views.sigma[:, None])
    curvature = np.where(newton[:, None], weights * np.maximum(weights * weights, 0.5), weights)
    curvature *= views.shared
    weighted = weights * views.shared * linear.residual
    by_phi, by_theta = linear.by_phi, linear.by_theta
    pp = (curvature * by_phi * by_phi).sum(axis=1) * (1.0 + damping) + 1e-12
    tt = (curvature * by_theta * by_theta).sum(axis=1) * (1.0 + damping) + 1e-12
    pt = (curvature * by_phi * by_theta).sum(axis=1)
    p, t = (weighted * by_phi).sum(axis=1), (weighted * by_theta).sum(axis=1)
    steps = np.stack([pt * t - tt * p, pt * p - pp * t], axis=1)
    return np.asarray(steps / (pp * tt - pt * pt)[:, None])


def _soft_l1_weights(scaled: Array) -> Array:
    return np.asarray(1.0 / np.sqrt(1.0 + np.square(scaled * (1.0 / KERNEL_SIGMAS))))


def _cost(linear: _Linearised, views: Rays) -> Array:
    scaled = linear.residual * (1.0 / (KERNEL_SIGMAS * views.sigma))[:, None]
    return np.asarray(((np.sqrt(1.0 + scaled * scaled) - 1.0) * views.shared).sum(axis=1))


def _covariance(
    linear: _Linearised, weights: Array, variance: Array, shared: Array
) -> tuple[Array, Mask]:
    """Return the covariances (R, 2, 2) of (φ, θ), and where they are sound."""
    J = np.stack([linear.by_phi, linear.by_theta], axis=1)
    info = (J * weights[:, None]) @ J.swapaxes(1, 2) / variance[:, None, None]
    significance, direction_info = _direction_information(linear, weights, variance, shared)
    phi_info = np.maximum(info[:, 0, 0], 1e-300)
    coupling = info[:, 0, 1] / phi_info
    v = 1.0 / np.maximum(direction_info - coupling * info[:, 0, 1], 1e-12)
    covariance = np.empty_like(info)
    covariance[:, 0, 0] = 1.0 / phi_info + coupling**2 * v
    covariance[:, 0, 1] = covariance[:, 1, 0] = -coupling * v
    covariance[:, 1, 1] = v
    sound = (phi_info * MAX_PHI_SD**2 >= 1.0) & (significance >= BASELINE_SIGNIFICANCE)
    sound &= (covariance[:, 0, 0] <= MAX_PHI_SD**2) & (v <= MAX_DIRECTION_SD**2)
    return covariance, sound


def _direction_information(
    linear: _Linearised, weights: Array, variance: Array, shared: Array
) -> tuple[Array, Array]:
    """Return how many sigmas the baselines stand out of the noise, and what θ is known by."""
    noise = linear.noise
    excess = linear.by_theta**2 / variance[:, None] - noise

    def debiased(w: Array) -> tuple[Array, Array]:
        signal = (w * excess).sum(axis=1)
        return signal, np.sqrt(2.0 * np.square(w * noise).sum(axis=1))

    shown, doubt = debiased(weights / (1.0 + noise))
    loud = np.maximum(MAX_NOISE, USUAL_NOISE * median(noise, shared))[:, None]
    sure, _ = debiased(np.where(noise < loud, weights, 0.0))
    everything, doubt_everything = debiased(weights)
    return shown / np.maximum(doubt, 1e-12), np.maximum(sure, everything - 2.0 * doubt_everything)


def median(values: Array, shared: Array) -> Array:
    """Return the medians (R,) of each robot's values (R, N), of the features shared."""
    ordered = np.sort(np.where(shared > 0.0, values, np.inf), axis=1)
    sizes = np.maximum(shared.sum(axis=1).astype(np.intp), 1)
    robots = np.arange(len(values))
    return np.asarray(0.5 * (ordered[robots, (sizes - 1) // 2] + ordered[robots, sizes // 2]))


def _along(rays: Parts, bearing: Array) -> Array:
    """Return rays as components (3, R, N) along, across and above bearings (R,)."""
    s, c = np.sin(bearing)[:, None], np.cos(bearing)[:, None]
    right, forward, up = rays
    return np.stack([s * right + c * forward, c * right - s * forward, up])
