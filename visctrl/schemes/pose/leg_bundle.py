"""Least squares over the first leg: residuals, normal equations, Levenberg–Marquardt.

Unknown are β, φ1, q and the turn ψ of every frame about its dead-reckoned heading, common to
all features, and two bearing errors of each feature. Features depend on each other through the
common part only: the normal equations have the shape of an arrow, and a step costs as much as
there are bearings. Everything works on S candidate solutions at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.robust.least_squares import (
    Damping,
    Options,
    Problem,
    Solved,
    levenberg_marquardt,
)
from visctrl.geometry.robust.losses import huber
from visctrl.geometry.trifocal.transfer import Transfer, transfer_bearing, wrap_half_turn
from visctrl.schemes.pose.first_leg import Leg

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: The common part and the bearing errors of one candidate.
Common = tuple[Array, Array]

#: Entries of the common part before the turns: β, φ1, q.
BASE = 3
#: Residuals beyond this many standard deviations pull with constant force.
HUBER = 2.5
#: A step with less gain is the last: 0.003 standard deviations.
_CONVERGED = 1e-5
#: The first steps are far from quadratic; a hundredth of damping loses none of the solutions.
_DAMPING = Damping(start=1e-2, shrink=0.2, grow=8.0, floor=1e-4)


@dataclass(frozen=True)
class Candidates:
    """Candidate solutions.

    common : (S, 3 + F), each (β, φ1, q, ψ of all frames).
    errors : (S, 2, N), of the features' bearings in the initial and the target view.
    """

    common: Array
    errors: Array

    @classmethod
    def of(cls, base: Array, leg: Leg) -> Candidates:
        """Return candidates from (S, 3), without turns or errors."""
        common = np.zeros((len(base), BASE + len(leg.motion)))
        common[:, :BASE] = base
        return cls(common, np.zeros((len(base), 2, len(leg.theta1))))

    def take(self, index: NDArray[np.intp]) -> Candidates:
        """Return some of them."""
        return Candidates(self.common[index], self.errors[index])

    @classmethod
    def stacked(cls, each: Sequence[Common]) -> Candidates:
        """Return candidates from each one's common part (3 + F,) and errors (2, N)."""
        common, errors = zip(*each, strict=True)
        return cls(np.array(common), np.array(errors))


class Normal(NamedTuple):
    """Normal equations in arrow shape, and the cost.

    The features' part is a symmetric 2 × 2 block each: (a, b; b, c).

    cost : (S,). common : (S, C, C). cross : (S, 2, N, C). feature : (S, 3, N), a, b and c.
    common_rhs : (S, C). feature_rhs : (S, 2, N).
    """

    cost: Array
    common: Array
    cross: Array
    feature: Array
    common_rhs: Array
    feature_rhs: Array


def residuals(leg: Leg, at: Candidates) -> tuple[Array, Array, Array]:
    """Return normalised residuals (S, F, N), and ∂ by (β, φ1, q) (3, …) and by errors (2, …).

    The derivative by the frame's own turn ψ is 1/σ.
    """
    transfer, common = _predict(leg, at)
    sigma = _sigma(leg)
    residual = wrap_half_turn(leg.theta2 - transfer.bearing) / sigma
    residual = np.where(np.isfinite(residual), residual, 0.0)
    return residual, common / sigma, -transfer.by_bearings / sigma


def normal_equations(leg: Leg, at: Candidates, weight: Array) -> Normal:
    """Return the normal equations with Huber's weights times ``weight`` (S, F, N)."""
    residual, base, errors = residuals(leg, at)
    size = np.abs(residual)
    pull = weight * huber(size, HUBER)
    inverse = 1.0 / _sigma(leg)
    turn = pull * inverse
    pulled_base, pulled_errors = pull * base, pull * errors
    smooth = _turn_information(leg)
    psi = at.common[:, BASE:]
    candidates, frames, features = residual.shape

    common = np.zeros((candidates, BASE + frames, BASE + frames))
    flat = np.moveaxis(base, 0, 1).reshape(candidates, BASE, -1)
    pulled_flat = np.moveaxis(pulled_base, 0, 1).reshape(candidates, BASE, -1)
    common[:, :BASE, :BASE] = pulled_flat @ np.swapaxes(flat, 1, 2)
    common[:, :BASE, BASE:] = np.moveaxis(np.sum(pulled_base * inverse, axis=3), 0, 1)
    common[:, BASE:, :BASE] = np.swapaxes(common[:, :BASE, BASE:], 1, 2)
    own = np.sum(turn * inverse, axis=2)
    common[:, BASE:, BASE:] = smooth + own[:, :, None] * np.eye(frames)
    cross = np.empty((candidates, 2, features, BASE + frames))
    for k in range(2):
        for i in range(BASE):
            cross[:, k, :, i] = np.sum(pulled_base[i] * errors[k], axis=1)
        cross[:, k, :, BASE:] = np.swapaxes(turn * errors[k], 1, 2)
    information = np.stack([leg.sigma1, leg.sigma3]) ** -2
    feature = np.empty((candidates, 3, features))
    feature[:, 0] = np.sum(pulled_errors[0] * errors[0], axis=1) + information[0]
    feature[:, 1] = np.sum(pulled_errors[0] * errors[1], axis=1)
    feature[:, 2] = np.sum(pulled_errors[1] * errors[1], axis=1) + information[1]

    common_rhs = np.empty((candidates, BASE + frames))
    common_rhs[:, :BASE] = (pulled_flat @ residual.reshape(candidates, -1, 1))[..., 0]
    common_rhs[:, BASE:] = np.sum(turn * residual, axis=2) - psi @ smooth
    feature_rhs = np.moveaxis(np.sum(pulled_errors * residual, axis=2), 0, 1)
    feature_rhs = feature_rhs - at.errors * information

    loss = np.where(size < HUBER, 0.5 * size**2, HUBER * (size - 0.5 * HUBER))
    cost = np.sum(loss * weight, axis=(1, 2)) + 0.5 * np.sum(psi @ smooth * psi, axis=1)
    cost += 0.5 * np.sum(at.errors**2 * information, axis=(1, 2))
    return Normal(cost, common, cross, feature, common_rhs, feature_rhs)


class _LegProblem(Problem[Common, None, Normal, Common]):
    """Candidate solutions of one leg side by side, each (β, φ1, q, ψ) and the bearing errors."""

    def __init__(self, leg: Leg, weight: Array) -> None:
        self._leg, self._weight = leg, weight

    def linearise(self, points: list[Common]) -> tuple[None, list[float], list[Normal]]:
        """Return costs and normal equations (see the contract)."""
        found = normal_equations(self._leg, Candidates.stacked(points), self._weight)
        normals = [Normal(*(part[k] for part in found)) for k in range(len(points))]
        return None, found.cost.tolist(), normals

    def steps(self, normals: list[Normal], damping: list[float]) -> list[Solved[Common]]:
        """Return the steps by the Schur complement of the bearing errors (see the contract)."""
        normal = Normal(*(np.stack(parts) for parts in zip(*normals, strict=True)))
        common, errors = _step(normal, np.array(damping))
        gain = np.sum(common * normal.common_rhs, axis=1)
        gain += np.sum(errors * normal.feature_rhs, axis=(1, 2))
        steps = zip(zip(common, errors, strict=True), gain.tolist(), strict=True)
        return [Solved(step, saved) for step, saved in steps]

    def moved(self, point: Common, step: Common, part: float) -> Common:
        """Return a candidate after a part of a step."""
        return point[0] + part * step[0], point[1] + part * step[1]


def descend(leg: Leg, at: Candidates, weight: Array, iterations: int) -> tuple[Candidates, Array]:
    """Return where Levenberg–Marquardt leads each candidate, and the costs (S,)."""
    options = Options(iterations + 1, converged=_CONVERGED, damping=_DAMPING)
    points = list(zip(at.common, at.errors, strict=True))
    found = levenberg_marquardt(_LegProblem(leg, weight), points, options)
    return Candidates.stacked(found.evaluated), np.array(found.costs)


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
    cross, (a, b, c) = normal.cross[0], normal.feature[0]
    n, k = len(a), len(keep)
    gain = _gain(normal.cross, normal.feature)[0].reshape(2 * n, -1)
    reduced = normal.common[0] - cross.reshape(2 * n, -1).T @ gain
    scale = np.sqrt(np.maximum(np.diag(reduced), 1e-300))
    balanced = reduced / np.outer(scale, scale)
    if np.linalg.eigvalsh(balanced)[0] < 1e-12:
        return np.full((k + 2 * n, k + 2 * n), np.inf)
    core = np.linalg.inv(balanced) / np.outer(scale, scale)
    P = np.empty((k + 2 * n, k + 2 * n))
    P[:k, :k] = core[np.ix_(keep, keep)]
    P[k:, :k] = -gain @ core[:, keep]
    P[:k, k:] = P[k:, :k].T
    P[k:, k:] = gain @ core @ gain.T
    first, second = k + np.arange(n), k + n + np.arange(n)
    determinant = a * c - b * b
    P[first, first] += c / determinant
    P[second, second] += a / determinant
    P[first, second] -= b / determinant
    P[second, first] -= b / determinant
    return P


def _gain(cross: Array, feature: Array) -> Array:
    """Return the features' own blocks inverted times what couples them to the common part.

    cross : (S, 2, N, …). feature : (S, 3, N).
    """
    a, b, c = (
        feature[:, k].reshape(*feature[:, k].shape, *[1] * (cross.ndim - 3)) for k in range(3)
    )
    inverse = 1.0 / (a * c - b * b)
    first, third = cross[:, 0], cross[:, 1]
    return np.stack([(c * first - b * third) * inverse, (a * third - b * first) * inverse], axis=1)


def _predict(leg: Leg, at: Candidates) -> tuple[Transfer, Array]:
    """Return the bearings (S, F, N), and their derivatives (3, S, F, N) by (β, φ1, q)."""
    beta, phi, q = (at.common[:, k] for k in range(BASE))
    sb, cb, sp, cp = np.sin(beta), np.cos(beta), np.sin(phi)[:, None], np.cos(phi)[:, None]
    initial = np.stack([sb, -cb, phi], axis=-1)
    dx, dy, turn = leg.motion[:, 0], leg.motion[:, 1], leg.motion[:, 2]
    forth = np.stack([cp * dx - sp * dy, sp * dx + cp * dy], axis=-1)
    current = np.empty((*forth.shape[:2], 3))
    current[..., :2] = initial[:, None, :2] + q[:, None, None] * forth
    current[..., 2] = phi[:, None] + turn + at.common[:, BASE:]
    transfer = transfer_bearing(
        initial[:, None, None, :],
        current[:, :, None, :],
        (leg.theta1 - at.errors[:, 0])[:, None, :],
        (leg.theta3 - at.errors[:, 1])[:, None, :],
    )
    x1, y1, phi1, x2, y2 = transfer.slopes[:5]
    x, y = forth[..., 0][..., None], forth[..., 1][..., None]
    by_common = np.empty((BASE, *x2.shape))
    by_common[0] = cb[:, None, None] * (x1 + x2) + sb[:, None, None] * (y1 + y2)
    by_common[1] = phi1 + 1.0 + q[:, None, None] * (x * y2 - y * x2)
    by_common[2] = x * x2 + y * y2
    return transfer, by_common


def _sigma(leg: Leg) -> Array:
    return np.where(np.isfinite(leg.sigma2), leg.sigma2, 1.0)


def _turn_information(leg: Leg) -> Array:
    """Return the information (F, F) of a random walk of the heading that starts at 0."""
    # A robot that stands, or one without noise, does not turn: by less than 1e-6 rad.
    steps = np.maximum(np.diff(leg.turn_variance, prepend=0.0), 1e-12)
    inverse = 1.0 / steps
    following = np.append(inverse[1:], 0.0)
    return np.diag(inverse + following) - np.diag(inverse[1:], 1) - np.diag(inverse[1:], -1)


def _step(normal: Normal, damping: Array) -> tuple[Array, Array]:
    """Return the damped Gauss–Newton step of the common part (S, C) and the errors (S, 2, N)."""
    scale = 1.0 + damping[:, None, None]
    candidates, size = normal.common_rhs.shape
    feature = normal.feature.copy()
    feature[:, ::2] *= scale
    common = normal.common * np.where(np.eye(size, dtype=bool), scale, 1.0) + 1e-12 * np.eye(size)
    gain = _gain(normal.cross, feature)
    # Σ over features and their two errors, as one matrix product per candidate.
    left = normal.cross.reshape(candidates, -1, size)
    flat = gain.reshape(candidates, -1, size)
    reduced = common - np.swapaxes(left, 1, 2) @ flat
    own = _gain(normal.feature_rhs, feature)
    rhs = normal.common_rhs - (normal.feature_rhs.reshape(candidates, 1, -1) @ flat)[:, 0]
    step = np.asarray(np.linalg.solve(reduced, rhs[..., None])[..., 0], dtype=np.float64)
    return step, own - (flat @ step[..., None]).reshape(own.shape)
