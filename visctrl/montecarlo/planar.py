"""Planar motions between many pairs of views: `visctrl.geometry.two_view.planar` in arrays.

R pairs of views with N features, some of them not shared. The equations and constants are those
of the single search, which is also what these functions are tested against.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from visctrl.geometry.trifocal.solvers import NOISE_MEDIAN, NOISE_MEDIAN_SD, SIGNIFICANCE
from visctrl.geometry.two_view.planar import MINIMUM_FEATURES, two_point_motions
from visctrl.montecarlo.planar_fit import Motions, Rays, median, refine
from visctrl.montecarlo.robots import Array, Index, Mask

#: Features on which every hypothesis is judged before the promising ones are on all.
_FIRST = 12
#: Robots whose hypotheses are judged at once: they fit in a processor's cache.
_AT_ONCE = 16


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
        inliers = np.abs(views.residuals(phi, direction)) < limit[:, None]
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
        The motions: see `visctrl.geometry.two_view.planar`.
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
