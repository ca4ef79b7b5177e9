"""Least squares over the first leg: residuals, normal equations, Levenberg–Marquardt.

Unknown are β, φ1, q and the turn ψ of every frame about its dead-reckoned heading, common to
all features, and two bearing errors of each feature. Features depend on each other through the
common part only: the normal equations have the shape of an arrow, and a step costs as much as
there are bearings. Everything works on S candidate solutions at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.estimation.pose_leg import HUBER, Leg
from visctrl.geometry.transfer import Transfer, transfer_bearing, wrap_half_turn

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Entries of the common part before the turns: β, φ1, q.
BASE = 3


@dataclass(frozen=True)
class Candidates:
    """Candidate solutions.

    common : (S, 3 + F), each (β, φ1, q, ψ of all frames).
    errors : (S, N, 2), of the features' bearings in the initial and the target view.
    """

    common: Array
    errors: Array

    @classmethod
    def of(cls, base: Array, leg: Leg) -> Candidates:
        """Return candidates from (S, 3), without turns or errors."""
        common = np.zeros((len(base), BASE + len(leg.motion)))
        common[:, :BASE] = base
        return cls(common, np.zeros((len(base), len(leg.theta1), 2)))

    def take(self, index: int) -> Candidates:
        """Return one of them."""
        return Candidates(self.common[[index]], self.errors[[index]])


@dataclass(frozen=True)
class Normal:
    """Normal equations in arrow shape, and the cost.

    cost : (S,). common : (S, C, C). cross : (S, N, C, 2). feature : (S, N, 2, 2).
    common_rhs : (S, C). feature_rhs : (S, N, 2).
    """

    cost: Array
    common: Array
    cross: Array
    feature: Array
    common_rhs: Array
    feature_rhs: Array


def residuals(leg: Leg, at: Candidates) -> tuple[Array, Array, Array]:
    """Return normalised residuals (S, F, N), and ∂ by (β, φ1, q) (…, 3) and by errors (…, 2).

    The derivative by the frame's own turn ψ is 1/σ.
    """
    transfer, by_initial, by_current = _predict(leg, at)
    sigma = _sigma(leg)
    residual = wrap_half_turn(leg.theta2 - transfer.bearing) / sigma
    residual = np.where(np.isfinite(residual), residual, 0.0)
    common = transfer.by_initial @ by_initial[:, None] + transfer.by_current @ by_current
    return residual, common / sigma[..., None], -transfer.by_bearings / sigma[..., None]


def normal_equations(leg: Leg, at: Candidates, weight: Array) -> Normal:
    """Return the normal equations with Huber's weights times ``weight`` (S, F, N)."""
    residual, base, errors = residuals(leg, at)
    pull = weight * np.minimum(1.0, HUBER / np.maximum(np.abs(residual), 1e-12))
    turn = pull / _sigma(leg)
    weighted_base, weighted_errors = pull[..., None] * base, pull[..., None] * errors
    smooth = _turn_information(leg)
    psi = at.common[:, BASE:]
    candidates, features = residual.shape[0], residual.shape[2]
    frames = len(leg.motion)
    size = BASE + frames

    common = np.zeros((candidates, size, size))
    common[:, :BASE, :BASE] = np.einsum("sfni,sfnj->sij", weighted_base, base)
    common[:, :BASE, BASE:] = np.einsum("sfn,sfni->sif", turn, base)
    common[:, BASE:, :BASE] = np.swapaxes(common[:, :BASE, BASE:], 1, 2)
    own = np.sum(turn / _sigma(leg), axis=2)
    common[:, BASE:, BASE:] = smooth + own[:, :, None] * np.eye(frames)
    cross = np.empty((candidates, features, size, 2))
    cross[:, :, :BASE] = np.einsum("sfni,sfnj->snij", weighted_base, errors)
    cross[:, :, BASE:] = np.swapaxes(turn[..., None] * errors, 1, 2)
    feature = np.einsum("sfni,sfnj->snij", weighted_errors, errors)
    feature[..., 0, 0] += 1.0 / leg.sigma1**2
    feature[..., 1, 1] += 1.0 / leg.sigma3**2

    common_rhs = np.empty((candidates, size))
    common_rhs[:, :BASE] = np.einsum("sfni,sfn->si", weighted_base, residual)
    common_rhs[:, BASE:] = np.sum(turn * residual, axis=2) - psi @ smooth
    feature_rhs = np.einsum("sfni,sfn->sni", weighted_errors, residual)
    feature_rhs[..., 0] -= at.errors[..., 0] / leg.sigma1**2
    feature_rhs[..., 1] -= at.errors[..., 1] / leg.sigma3**2

    prior = (at.errors[..., 0] / leg.sigma1) ** 2 + (at.errors[..., 1] / leg.sigma3) ** 2
    cost = _huber(residual, weight) + 0.5 * np.sum(prior, axis=1)
    cost += 0.5 * np.einsum("sf,fg,sg->s", psi, smooth, psi)
    return Normal(cost, common, cross, feature, common_rhs, feature_rhs)


def descend(leg: Leg, at: Candidates, weight: Array, iterations: int) -> tuple[Candidates, Array]:
    """Return where Levenberg–Marquardt leads each candidate, and the costs (S,)."""
    damping = np.full(len(at.common), 1e-2)
    normal = normal_equations(leg, at, weight)
    for _ in range(iterations):
        common, errors = _step(normal, damping)
        trial = Candidates(at.common + common, at.errors + errors)
        found = normal_equations(leg, trial, weight)
        better = found.cost < normal.cost
        gain = normal.cost - found.cost
        damping = np.where(better, damping * 0.2, np.maximum(damping, 1e-4) * 8.0)
        at = Candidates(
            _choose(better, trial.common, at.common), _choose(better, trial.errors, at.errors)
        )
        normal = Normal(*(_choose(better, vars(found)[k], v) for k, v in vars(normal).items()))
        if not (better & (gain > 1e-4)).any() and (damping > 1e-3).all():
            break
        if better.all() and (gain < 1e-6).all():
            break
    return at, normal.cost


def covariance(normal: Normal, keep: NDArray[np.intp]) -> Array:
    """Return the covariance of the first candidate's unknowns, infinite where undetermined.

    Parameters
    ----------
    normal : Normal
    keep : (K,) int array
        Which of the common unknowns to keep.

    Returns
    -------
    (K + 2N, K + 2N) array
        In the order: those, all errors in the initial view, all errors in the target view.
    """
    common, cross, feature = normal.common[0], normal.cross[0], normal.feature[0]
    n, k = len(feature), len(keep)
    gain = np.linalg.solve(feature, np.swapaxes(cross, -1, -2))
    reduced = common - np.tensordot(cross, gain, axes=([0, 2], [0, 1]))
    scale = np.sqrt(np.maximum(np.diag(reduced), 1e-300))
    balanced = reduced / np.outer(scale, scale)
    if np.linalg.eigvalsh(balanced)[0] < 1e-12:
        return np.full((k + 2 * n, k + 2 * n), np.inf)
    core = np.linalg.inv(balanced) / np.outer(scale, scale)
    stacked = np.concatenate([gain[:, 0], gain[:, 1]])
    P = np.empty((k + 2 * n, k + 2 * n))
    P[:k, :k] = core[np.ix_(keep, keep)]
    P[k:, :k] = -stacked @ core[:, keep]
    P[:k, k:] = P[k:, :k].T
    P[k:, k:] = stacked @ core @ stacked.T
    own = np.linalg.inv(feature)
    first, second = k + np.arange(n), k + n + np.arange(n)
    P[first, first] += own[:, 0, 0]
    P[first, second] += own[:, 0, 1]
    P[second, first] += own[:, 1, 0]
    P[second, second] += own[:, 1, 1]
    return P


def _predict(leg: Leg, at: Candidates) -> tuple[Transfer, Array, Array]:
    """Return the bearings (S, F, N), and ∂C1 (S, 3, 3), ∂C2 (S, F, 3, 3) by (β, φ1, q)."""
    beta, phi, q = (at.common[:, k] for k in range(BASE))
    sb, cb, sp, cp = np.sin(beta), np.cos(beta), np.sin(phi)[:, None], np.cos(phi)[:, None]
    initial = np.stack([sb, -cb, phi], axis=-1)
    dx, dy, turn = leg.motion[:, 0], leg.motion[:, 1], leg.motion[:, 2]
    forth = np.stack([cp * dx - sp * dy, sp * dx + cp * dy], axis=-1)
    current = np.empty((*forth.shape[:2], 3))
    current[..., :2] = initial[:, None, :2] + q[:, None, None] * forth
    current[..., 2] = phi[:, None] + turn + at.common[:, BASE:]
    by_initial = np.zeros((len(q), 3, 3))
    by_initial[:, 0, 0], by_initial[:, 1, 0], by_initial[:, 2, 1] = cb, sb, 1.0
    by_current = np.zeros((*current.shape, 3))
    by_current[..., 0, 0], by_current[..., 1, 0] = cb[:, None], sb[:, None]
    by_current[..., 0, 1] = -q[:, None] * forth[..., 1]
    by_current[..., 1, 1] = q[:, None] * forth[..., 0]
    by_current[..., 2, 1] = 1.0
    by_current[..., :2, 2] = forth
    transfer = transfer_bearing(
        initial[:, None, None, :],
        current[:, :, None, :],
        (leg.theta1 - at.errors[..., 0])[:, None, :],
        (leg.theta3 - at.errors[..., 1])[:, None, :],
    )
    return transfer, by_initial, by_current


def _sigma(leg: Leg) -> Array:
    return np.where(np.isfinite(leg.sigma2), leg.sigma2, 1.0)


def _turn_information(leg: Leg) -> Array:
    """Return the information (F, F) of a random walk of the heading that starts at 0."""
    # A robot that stands, or one without noise, does not turn: by less than 1e-6 rad.
    steps = np.maximum(np.diff(leg.turn_variance, prepend=0.0), 1e-12)
    inverse = 1.0 / steps
    following = np.append(inverse[1:], 0.0)
    return np.diag(inverse + following) - np.diag(inverse[1:], 1) - np.diag(inverse[1:], -1)


def _huber(residual: Array, weight: Array) -> Array:
    size = np.abs(residual)
    loss = np.where(size < HUBER, 0.5 * size**2, HUBER * (size - 0.5 * HUBER))
    return np.asarray(np.sum(loss * weight, axis=(1, 2)), dtype=np.float64)


def _step(normal: Normal, damping: Array) -> tuple[Array, Array]:
    """Return the damped Gauss–Newton step of the common part (S, C) and the errors (S, N, 2)."""
    scale = 1.0 + damping[:, None, None]
    size = normal.common.shape[-1]
    feature = normal.feature * np.where(np.eye(2, dtype=bool), scale[..., None], 1.0)
    common = normal.common * np.where(np.eye(size, dtype=bool), scale, 1.0) + 1e-12 * np.eye(size)
    gain = np.linalg.solve(feature, np.swapaxes(normal.cross, -1, -2))
    # Σ over features and their two errors, as one matrix product per candidate.
    left = np.swapaxes(normal.cross, 1, 2).reshape(len(common), size, -1)
    reduced = common - left @ gain.reshape(len(common), -1, size)
    rhs = normal.common_rhs - np.einsum("snji,snj->si", gain, normal.feature_rhs)
    step = np.linalg.solve(reduced, rhs[..., None])[..., 0]
    own = np.linalg.solve(feature, normal.feature_rhs[..., None])[..., 0]
    return step, own - np.einsum("snij,sj->sni", gain, step)


def _choose(which: Mask, a: Array, b: Array) -> Array:
    return np.where(which.reshape(-1, *[1] * (a.ndim - 1)), a, b)
