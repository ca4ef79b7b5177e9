"""Where the robot started, from the bearings it saw on a first short leg of known motion.

Maximum a posteriori over all frames of the leg. Unknown are the direction β and heading φ1 of
the start C1 = |C1| (sin β, −cos β, φ1) in the target's frame, the scale q = 1/|C1| and the
errors e1, e3 of every feature's bearing in the two fixed views, whose noise is the same in all
frames. Positions are in units of |C1|; the known motion δ of the leg, in metres, fixes q:

    C2 = C1 + q R(φ1) δ,        θ2 = transfer of (θ1 − e1, θ3 − e3) to C2 + noise.

Features depend on each other through (β, φ1, q) only, so that the normal equations have the
shape of an arrow and a step costs as much as there are bearings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.estimation.pose_leg import HUBER, Leg, apart, binned, in_front, search_starts, seen
from visctrl.geometry.transfer import Transfer, transfer_bearing, wrap_half_turn

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Each feature has two errors to find, and three numbers are common to all.
MINIMUM_FEATURES = 5
#: Sine of the angle between a feature's rays in the initial and target view below which the
#: noise of those two decides where the feature is.
MINIMUM_PARALLAX = 0.12
#: Beyond this many standard deviations a bearing is an error, not noise.
_OUTLIER = 4.0


@dataclass(frozen=True)
class Start:
    """Pose of the first view in the target's frame, in units of their distance.

    beta, phi : direction and heading of C1 (rad).
    q : 1/|C1| (1/m).
    errors : (N, 2) errors of the bearings in the initial and the target view (rad).
    covariance : (3 + 2N, 3 + 2N), of (β, φ1, q, e1 of all features, e3 of all features).
    used : (N,) features that agree with the solution.
    cost : half the sum of squared normalised residuals.
    rival : cost of the best solution that is clearly another one, less ``cost``.
    """

    beta: float
    phi: float
    q: float
    errors: Array
    covariance: Array
    used: Mask
    cost: float
    rival: float

    @property
    def relative_scale_sd(self) -> float:
        """Standard deviation of the distance |C1| as a fraction of it."""
        return float(np.sqrt(self.covariance[2, 2])) / self.q

    @property
    def finite(self) -> bool:
        """Whether the solution determines anything."""
        return bool(np.isfinite(self.covariance).all()) and self.q > 0.0


@dataclass
class _Point:
    """S candidate solutions: common part (S, 3) and bearing errors (S, N, 2)."""

    common: Array
    errors: Array


@dataclass(frozen=True)
class _Normal:
    """Normal equations in arrow shape, and the cost."""

    cost: Array
    common: Array
    cross: Array
    feature: Array
    common_rhs: Array
    feature_rhs: Array


def solve_leg(leg: Leg, previous: Start | None = None, starts: int = 8) -> Start | None:
    """Return the most probable start of a leg, or None when too little was seen.

    Parameters
    ----------
    leg : Leg
    previous : Start, optional
        Solution of a shorter leg from the same C1: one more place to begin from.
    starts : int
        Number of other places to begin from, the best of a search over both angles.
    """
    if np.isfinite(leg.theta2).any(axis=0).sum() < MINIMUM_FEATURES:
        return None
    coarse = binned(leg)
    common = search_starts(coarse, starts)
    if previous is not None:
        common = np.vstack([[previous.beta, previous.phi, previous.q], common])
    if not len(common):
        return None
    point = _Point(common, np.zeros((len(common), len(leg.theta1), 2)))
    # Far from the solution, features near the baseline of the fixed views lead astray.
    for iterations, parallax in ((8, 3.0 * MINIMUM_PARALLAX), (20, MINIMUM_PARALLAX)):
        weight = _weights(coarse, point, parallax)
        point, cost = _descend(coarse, point, weight, iterations)
    # Rows left out count as if they fitted as well as noise does.
    cost = cost + 0.5 * np.sum(seen(coarse) - weight, axis=(1, 2))
    good = (point.common[:, 2] > 0.0) & np.isfinite(cost) & in_front(leg, point.common)
    if not good.any():
        return None
    cost = np.where(good, cost, np.inf)
    best = int(np.argmin(cost))
    rival = _rival(point.common, cost, best)
    return _finish(leg, _Point(point.common[[best]], point.errors[[best]]), rival)


def _weights(leg: Leg, point: _Point, minimum: float = MINIMUM_PARALLAX) -> Array:
    """Return 1 for the bearings (S, F, N) that are seen with a parallax over ``minimum``.

    The eight features with the largest parallax are kept in any case.
    """
    parallax = np.abs(np.sin(leg.theta3 - leg.theta1 + point.common[:, 1:2]))
    ranked = np.sort(parallax, axis=1)[:, -min(8, parallax.shape[1]), None]
    well = (parallax >= np.minimum(minimum, ranked))[:, None, :]
    return np.asarray(seen(leg) * well, dtype=np.float64)


def _rival(common: Array, cost: Array, best: int) -> float:
    """Return by how much the cost of the nearest competitor exceeds the best one."""
    others = [
        float(cost[i] - cost[best])
        for i in range(len(cost))
        if apart(common[i], common[best]) > 0.1 or abs(common[i, 2] / common[best, 2] - 1) > 0.3
    ]
    return min(others, default=float("inf"))


def _predict(leg: Leg, point: _Point) -> tuple[Transfer, Array, Array]:
    """Return the transferred bearings (S, F, N) and ∂C1 (S, 3, 3), ∂C2 (S, F, 3, 3) by common."""
    beta, phi, q = (point.common[:, k] for k in range(3))
    sb, cb, sp, cp = np.sin(beta), np.cos(beta), np.sin(phi)[:, None], np.cos(phi)[:, None]
    initial = np.stack([sb, -cb, phi], axis=-1)
    dx, dy, turn = leg.motion[:, 0], leg.motion[:, 1], leg.motion[:, 2]
    forth = np.stack([cp * dx - sp * dy, sp * dx + cp * dy], axis=-1)
    current = np.empty((*forth.shape[:2], 3))
    current[..., :2] = initial[:, None, :2] + q[:, None, None] * forth
    current[..., 2] = phi[:, None] + turn
    by_initial = np.zeros((len(q), 3, 3))
    by_initial[:, 0, 0], by_initial[:, 1, 0], by_initial[:, 2, 1] = cb, sb, 1.0
    by_current = np.zeros((*current.shape, 3))
    by_current[..., 0, 0], by_current[..., 1, 0] = cb[:, None], sb[:, None]
    by_current[..., 0, 1], by_current[..., 1, 1] = (
        -q[:, None] * forth[..., 1],
        (q[:, None] * forth[..., 0]),
    )
    by_current[..., 2, 1] = 1.0
    by_current[..., :2, 2] = forth
    transfer = transfer_bearing(
        initial[:, None, None, :],
        current[:, :, None, :],
        (leg.theta1 - point.errors[..., 0])[:, None, :],
        (leg.theta3 - point.errors[..., 1])[:, None, :],
    )
    return transfer, by_initial, by_current


def _residuals(leg: Leg, point: _Point) -> tuple[Array, Array, Array]:
    """Return normalised residuals (S, F, N) and ∂ by common (…, 3) and by errors (…, 2)."""
    transfer, by_initial, by_current = _predict(leg, point)
    sigma = np.where(np.isfinite(leg.sigma2), leg.sigma2, 1.0)
    residual = wrap_half_turn(leg.theta2 - transfer.bearing) / sigma
    residual = np.where(np.isfinite(residual), residual, 0.0)
    common = transfer.by_initial @ by_initial[:, None] + transfer.by_current @ by_current
    return residual, common / sigma[..., None], -transfer.by_bearings / sigma[..., None]


def _robust_cost(leg: Leg, point: _Point, residual: Array, weight: Array) -> Array:
    size = np.abs(residual)
    loss = np.where(size < HUBER, 0.5 * size**2, HUBER * (size - 0.5 * HUBER))
    prior = (point.errors[..., 0] / leg.sigma1) ** 2 + (point.errors[..., 1] / leg.sigma3) ** 2
    return np.asarray(np.sum(loss * weight, axis=(1, 2)) + 0.5 * np.sum(prior, axis=1))


def _normal_equations(leg: Leg, point: _Point, weight: Array) -> _Normal:
    residual, common, errors = _residuals(leg, point)
    pull = weight * np.minimum(1.0, HUBER / np.maximum(np.abs(residual), 1e-12))
    weighted_common, weighted_errors = pull[..., None] * common, pull[..., None] * errors
    feature = np.einsum("sfni,sfnj->snij", weighted_errors, errors)
    feature[..., 0, 0] += 1.0 / leg.sigma1**2
    feature[..., 1, 1] += 1.0 / leg.sigma3**2
    feature_rhs = np.einsum("sfni,sfn->sni", weighted_errors, residual)
    feature_rhs[..., 0] -= point.errors[..., 0] / leg.sigma1**2
    feature_rhs[..., 1] -= point.errors[..., 1] / leg.sigma3**2
    return _Normal(
        _robust_cost(leg, point, residual, weight),
        np.einsum("sfni,sfnj->sij", weighted_common, common),
        np.einsum("sfni,sfnj->snij", weighted_common, errors),
        feature,
        np.einsum("sfni,sfn->si", weighted_common, residual),
        feature_rhs,
    )


def _step(normal: _Normal, damping: Array) -> tuple[Array, Array]:
    """Return the damped Gauss–Newton step of the common part (S, 3) and the errors (S, N, 2)."""
    scale = 1.0 + damping[:, None, None]
    feature = normal.feature * np.where(np.eye(2, dtype=bool), scale[..., None], 1.0)
    common = normal.common * np.where(np.eye(3, dtype=bool), scale, 1.0) + 1e-12 * np.eye(3)
    gain = np.linalg.solve(feature, np.swapaxes(normal.cross, -1, -2))
    reduced = common - np.einsum("snij,snjk->sik", normal.cross, gain)
    rhs = normal.common_rhs - np.einsum("snji,snj->si", gain, normal.feature_rhs)
    step = np.linalg.solve(reduced, rhs[..., None])[..., 0]
    own = np.linalg.solve(feature, normal.feature_rhs[..., None])[..., 0]
    return step, own - np.einsum("snij,sj->sni", gain, step)


def _descend(leg: Leg, point: _Point, weight: Array, iterations: int) -> tuple[_Point, Array]:
    """Return where Levenberg–Marquardt leads each candidate, and the costs (S,)."""
    damping = np.full(len(point.common), 1e-2)
    normal = _normal_equations(leg, point, weight)
    for _ in range(iterations):
        common, errors = _step(normal, damping)
        trial = _Point(point.common + common, point.errors + errors)
        found = _normal_equations(leg, trial, weight)
        better = found.cost < normal.cost
        gain = normal.cost - found.cost
        damping = np.where(better, damping * 0.2, np.maximum(damping, 1e-4) * 8.0)
        point = _Point(
            np.where(better[:, None], trial.common, point.common),
            np.where(better[:, None, None], trial.errors, point.errors),
        )
        normal = _Normal(*(_choose(better, vars(found)[k], v) for k, v in vars(normal).items()))
        if not (better & (gain > 1e-4)).any() and (damping > 1e-3).all():
            break
        if better.all() and (gain < 1e-6).all():
            break
    return point, normal.cost


def _choose(which: Mask, a: Array, b: Array) -> Array:
    return np.where(which.reshape(-1, *[1] * (a.ndim - 1)), a, b)


def _finish(leg: Leg, point: _Point, rival: float) -> Start:
    """Drop what disagrees, settle on the rest and return the solution with its covariance."""
    weight = _weights(leg, point)
    for _ in range(2):
        residual, _, _ = _residuals(leg, point)
        weight = weight * (np.abs(residual) < _OUTLIER)
        point, _ = _descend(leg, point, weight, iterations=10)
    normal = _normal_equations(leg, point, weight)
    frames = seen(leg).sum(axis=0)
    errors = point.errors[0]
    plain = np.abs(errors / np.stack([leg.sigma1, leg.sigma3], axis=-1)).max(axis=-1) < _OUTLIER
    used = plain & (weight[0].sum(axis=0) > 0.5 * np.maximum(frames, 1.0))
    beta, phi, q = point.common[0]
    return Start(
        float(beta),
        float(phi),
        float(q),
        errors,
        _covariance(normal),
        used,
        float(normal.cost[0]),
        rival,
    )


def _covariance(normal: _Normal) -> Array:
    """Return the inverse (3 + 2N, 3 + 2N) of the first candidate's normal matrix."""
    common, cross, feature = normal.common[0], normal.cross[0], normal.feature[0]
    n = len(feature)
    gain = np.linalg.solve(feature, np.swapaxes(cross, -1, -2))
    reduced = common - np.einsum("nij,njk->ik", cross, gain)
    if np.linalg.cond(reduced) > 1e14:
        return np.full((3 + 2 * n, 3 + 2 * n), np.inf)
    core = np.linalg.inv(reduced)
    # Rows of the errors are ordered as all e1, then all e3.
    stacked = np.concatenate([gain[:, 0], gain[:, 1]])
    P = np.empty((3 + 2 * n, 3 + 2 * n))
    P[:3, :3] = core
    P[3:, :3] = -stacked @ core
    P[:3, 3:] = P[3:, :3].T
    P[3:, 3:] = stacked @ core @ stacked.T
    own = np.linalg.inv(feature)
    first, second = 3 + np.arange(n), 3 + n + np.arange(n)
    P[first, first] += own[:, 0, 0]
    P[first, second] += own[:, 0, 1]
    P[second, first] += own[:, 1, 0]
    P[second, second] += own[:, 1, 1]
    return P
