"""Planar motions of many pairs of views, refined: `visctrl.geometry.planar` in arrays.

R pairs of views with N features, some of them not shared. The equations and constants are those
of the single refinement, which is also what these functions are tested against.
"""

from __future__ import annotations

import copy
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
    NEAR,
    NEAREST,
    STILL,
    USUAL_NOISE,
)
from visctrl.montecarlo.robots import Array, Index, Mask, Parts, Robots


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
