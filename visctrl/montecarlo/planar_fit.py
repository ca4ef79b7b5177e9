"""Planar motions of many pairs of views, refined by `visctrl.geometry.two_view.planar`."""

from __future__ import annotations

import copy
from typing import NamedTuple

import numpy as np

from visctrl.contracts import Health
from visctrl.geometry.two_view.parallax import meeting
from visctrl.geometry.two_view.planar import NEAREST, refine_motions
from visctrl.geometry.two_view.planar_fit import Motion, RayPairs
from visctrl.montecarlo.robots import Array, Mask, Parts, Robots
from visctrl.robots.unicycle import wrap_angle

#: Pairs of views that are refined at once: they fit in a processor's cache.
_AT_ONCE = 16


class Motions(NamedTuple):
    """Planar motions of R pairs of views: see `visctrl.geometry.two_view.planar.PlanarMotion`.

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

    def pairs(self, which: slice = slice(None)) -> RayPairs:
        """Return some of the pairs as the refinement takes them."""
        a, b = (np.stack([part[which] for part in rays], axis=1) for rays in (self.a, self.b))
        return RayPairs(a, b)

    def residuals(self, phi: Array, direction: Array) -> Array:
        """Return the Sampson residuals (R, N) in rad of motions (R,)."""
        linear = self.pairs().linearised(_each(phi, direction))
        return linear.residual.reshape(self.shared.shape)

    def parallax(self, phi: Array, direction: Array) -> Array:
        """Return signed parallaxes (R, N): see `visctrl.geometry.two_view.parallax.signed_parallax`."""
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


def refine(views: Rays, phi: Array, direction: Array) -> Motions:
    """Return motions refined from a start, those of too few features at zero."""
    starts, found = _each(phi, direction), []
    for first in range(0, len(starts), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        present = views.shared[some] > 0.0
        found += refine_motions(views.pairs(some), starts[some], views.sigma[some], present=present)
    return Motions(
        np.array([motion.phi for motion in found]),
        np.array([motion.direction for motion in found]),
        np.array([motion.covariance for motion in found]).reshape(-1, 2, 2),
        np.array([motion.health is Health.OK for motion in found], dtype=np.bool_),
    )


def median(values: Array, shared: Array) -> Array:
    """Return the medians (R,) of each robot's values (R, N), of the features shared."""
    ordered = np.sort(np.where(shared > 0.0, values, np.inf), axis=1)
    sizes = np.maximum(shared.sum(axis=1).astype(np.intp), 1)
    robots = np.arange(len(values))
    return np.asarray(0.5 * (ordered[robots, (sizes - 1) // 2] + ordered[robots, sizes // 2]))


def _each(phi: Array, direction: Array) -> list[Motion]:
    return list(zip(phi.tolist(), direction.tolist(), strict=True))


def _along(rays: Parts, bearing: Array) -> Array:
    """Return rays as components (3, R, N) along, across and above bearings (R,)."""
    s, c = np.sin(bearing)[:, None], np.cos(bearing)[:, None]
    right, forward, up = rays
    return np.stack([s * right + c * forward, c * right - s * forward, up])
