"""Where the robot started, from the bearings it saw on a first short leg of known motion.

Maximum a posteriori over all frames of the leg. Unknown are the direction β and heading φ1 of
the start C1 = |C1| (sin β, −cos β, φ1) in the target's frame, the scale q = 1/|C1|, the
deviations ψ of the headings on the way from dead reckoning, and the errors e1, e3 of every
feature's bearing in the two fixed views, whose noise is the same in all frames. Positions are
in units of |C1|; the dead-reckoned motion δ of the leg, in metres, fixes q:

    C2 = C1 + q R(φ1) δ,        θ2 = transfer of (θ1 − e1, θ3 − e3) to C2 + ψ + noise.

Places to begin from come from a search over both angles: each pair of them supposes a scale, which
is linear in the features' inverse ranges.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.robust.losses import huber
from visctrl.geometry.trifocal.transfer import wrap_half_turn
from visctrl.schemes.pose.first_leg import Leg, seen
from visctrl.schemes.pose.leg_bundle import (
    BASE,
    HUBER,
    Candidates,
    covariance,
    descend,
    normal_equations,
    residuals,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Places to begin from are at least so far apart (rad).
_SPREAD = math.radians(15.0)
#: Each feature has two errors to find, and three numbers are common to all.
MINIMUM_FEATURES = 5
#: Sine of the angle between a feature's rays in the initial and target view below which the
#: noise of those two decides where the feature is.
MINIMUM_PARALLAX = 0.12
#: Of the places to begin from, how many are gone on with after a few steps, and how many steps.
_FINALISTS, _FIRST_STEPS = 8, 2
#: Two starts whose angles (rad) and scales differ by less lead to the same solution.
_SAME = 1e-3
#: Beyond this many standard deviations a bearing is an error, not noise.
_OUTLIER = 4.0


def binned(leg: Leg, bins: int = 8) -> Leg:
    """Return the leg with its frames averaged in groups: enough to find where to start.

    Along a few centimetres a bearing, the turn removed, changes in proportion to the way.
    """
    frames = len(leg.motion)
    if frames <= bins:
        return leg
    group = np.arange(frames) * bins // frames
    change = wrap_half_turn(leg.theta2 - leg.motion[:, 2:] - leg.theta1)
    members = (group == np.arange(bins)[:, None]).astype(np.float64)
    motion = members @ leg.motion / members.sum(axis=1, keepdims=True)
    count = members @ seen(leg)
    some = np.where(count > 0, count, np.nan)
    mean = members @ np.where(np.isfinite(change), change, 0.0) / some
    variance = members @ np.where(np.isfinite(leg.sigma2), leg.sigma2, 0.0) ** 2 / some
    return replace(
        leg,
        motion=motion,
        turn_variance=members @ leg.turn_variance / members.sum(axis=1),
        theta2=leg.theta1 + motion[:, 2:] + mean,
        sigma2=np.sqrt(variance / some),
    )


def search_starts(leg: Leg, count: int, step_deg: float = 8.0) -> Array:
    """Return up to ``count`` promising (β, φ1, q), (S, 3), by a search over both angles."""
    angles = np.radians(np.arange(-180.0, 180.0, step_deg))
    beta, phi = (part.ravel() for part in np.meshgrid(angles, angles, indexing="ij"))
    # The same scale fits a start turned by half a circle about the target, points behind it.
    front = in_front(leg.theta1, leg.theta3, np.stack([beta, phi], axis=-1))
    beta, phi = beta[front], phi[front]
    # Half a cell of the search shifts the prediction by some 20 % of the value.
    q, score = scale_of(leg, beta, phi, spread=0.2)
    score[q <= 0.0] = np.inf
    return _spread_minima(np.stack([beta, phi, q], axis=-1), score, count)


def _inverse_ranges(leg: Leg) -> tuple[Array, Array]:
    """Return the inverse ranges from C1 (1/m) of the features (N,) and their variances.

    A point at range r and bearing θ1 is seen from δ at θ2 + dφ with
    tan(θ2 + dφ − θ1) = −t·δ / (r − d·δ), d and t being the ray's direction and its normal.
    """
    change = wrap_half_turn(leg.theta2 - leg.motion[:, 2:] - leg.theta1)
    s, c = np.sin(leg.theta1), np.cos(leg.theta1)
    across = leg.motion[:, :1] * c - leg.motion[:, 1:2] * s
    along = leg.motion[:, :1] * s + leg.motion[:, 1:2] * c
    tangent = np.tan(np.clip(change, -1.2, 1.2))
    lever = np.where(np.isfinite(tangent), along * tangent - across, 0.0)
    tangent = np.where(np.isfinite(tangent), tangent, 0.0)
    information = np.sum(lever**2, axis=0)
    # Straight ahead there is no lever: such a feature tells nothing about its range.
    information = np.where(information > 1e-6, information, np.nan)
    rho = np.sum(lever * tangent, axis=0) / information
    noise = np.nanmean(leg.sigma2, axis=0) ** 2 / information
    common = (leg.sigma1 * np.sum(np.abs(lever), axis=0) / information) ** 2
    return rho, noise + common


def scale_of(leg: Leg, beta: Array, phi: Array, spread: float = 0.05) -> tuple[Array, Array]:
    """Return the scale q (S,) that supposed angles (S,) of C1 imply, and how badly it fits (S,).

    Each feature's bearing changes along the leg give its inverse range, which is linear in q
    once β and φ1 are supposed, so that a plane of hypotheses is scored in one array operation.

    Parameters
    ----------
    leg : Leg
    beta, phi : (S,) arrays
        Direction and heading of C1 (rad).
    spread : float
        Standard deviation of an inverse range, as a fraction, that is due to the angles.
    """
    inverse_range, variance = _inverse_ranges(leg)
    known = np.isfinite(inverse_range)
    rho, variance = inverse_range[known], variance[known]
    theta3 = leg.theta3[known]
    # C1 × d3 over d3 × d1 is the range from C1 in units of |C1|.
    reach = _sines(beta, theta3)
    reach = np.copysign(np.maximum(np.abs(reach), 0.05), reach)
    # Both in standard deviations.
    k = _sines(phi, theta3 - leg.theta1[known]) / reach
    scale = 1.0 / np.sqrt(variance + (spread * rho) ** 2)
    k, rho = k * scale, rho * scale
    along, square = k * rho, k * k
    pull = np.ones_like(k)
    for _ in range(3):
        q = np.einsum("sn,sn->s", pull, along) / np.einsum("sn,sn->s", pull, square)
        scaled = np.abs(rho - q[:, None] * k)
        pull = huber(scaled, HUBER)
    # Huber's loss, as a sum of squares.
    clipped = np.minimum(scaled, HUBER)
    return q, np.sum(clipped * (2.0 * scaled - clipped), axis=1)


def _sines(angle: Array, theta: Array) -> Array:
    """Return sin(angle + theta), (S, N), for (S,) and (N,): one matrix product."""
    turn = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    return np.asarray(turn @ np.stack([np.cos(theta), np.sin(theta)]), dtype=np.float64)


def in_front(theta1: Array, theta3: Array, common: Array) -> Mask:
    """Return which solutions (S, 2 or more) have their points in front of both fixed views.

    theta1, theta3 : (N,) bearings in the initial and the target view (rad).
    common : (S, 2 or more) direction β and heading φ1 of C1 (rad), and anything.
    """
    beta, phi = common[:, 0], common[:, 1]
    parallax = _sines(phi, theta3 - theta1)
    range1, range3 = _sines(beta, theta3), _sines(beta - phi, theta1)
    # Far points lie on either side by chance: they vote with their parallax.
    first = np.einsum("sn,sn->s", np.sign(range1), parallax)
    third = np.einsum("sn,sn->s", np.sign(range3), parallax)
    return np.asarray((first > 0.0) & (third > 0.0))


def _spread_minima(candidates: Array, score: Array, count: int) -> Array:
    """Return the best candidates (·, 3) that are at least 15 degrees apart."""
    chosen: list[list[float]] = []
    best = np.argsort(score)[: 40 * count]
    for candidate in candidates[best[np.isfinite(score[best])]].tolist():
        if len(chosen) == count:
            break
        if all(apart(candidate, other) > _SPREAD for other in chosen):
            chosen.append(candidate)
    return np.array(chosen).reshape(-1, 3)


def apart(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the larger of the differences of β and φ1 (rad) of two solutions (β, φ1, …)."""
    return max(abs(math.remainder(x - y, math.tau)) for x, y in zip(a[:2], b[:2], strict=True))


@dataclass(frozen=True)
class LegSolution:
    """Pose of the first view in the target's frame, in units of their distance.

    beta, phi : direction and heading of C1 (rad).
    q : 1/|C1| (1/m).
    turn : heading at the end of the leg less the dead-reckoned one (rad).
    errors : (2, N) errors of the bearings in the initial and the target view (rad).
    covariance : (4 + 2N, 4 + 2N), of (β, φ1, q, turn, e1 of all, e3 of all features).
    tested : (N,) features with so much parallax that the solution can be tested on them.
    used : (N,) those that agree with it.
    cost : half the sum of squared normalised residuals.
    rival : cost of the best solution that is clearly another one, less ``cost``.
    """

    beta: float
    phi: float
    q: float
    turn: float
    errors: Array
    covariance: Array
    tested: Mask
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


def solve_leg(
    leg: Leg, previous: LegSolution | None = None, starts: int = 24
) -> LegSolution | None:
    """Return the most probable start of a leg, or None when too little was seen.

    Parameters
    ----------
    leg : Leg
    previous : LegSolution, optional
        Solution of a shorter leg from the same C1: one more place to begin from.
    starts : int
        Number of other places to begin from, the best of a search over both angles.
    """
    if np.isfinite(leg.theta2).any(axis=0).sum() < MINIMUM_FEATURES:
        return None
    coarse = binned(leg)
    base = search_starts(coarse, starts)
    if previous is not None:
        base = np.vstack([[previous.beta, previous.phi, previous.q], base])
    if not len(base):
        return None
    at = Candidates.of(base, coarse)
    # Far from the solution, features near the baseline of the fixed views lead astray.
    weight = _weights(coarse, at, 3.0 * MINIMUM_PARALLAX)
    at, cost = descend(coarse, at, weight, iterations=_FIRST_STEPS)
    best = np.argsort(cost + _left_out(coarse, weight))[:_FINALISTS]
    at, cost = descend(coarse, at.take(best), weight[best], iterations=8)
    at = at.take(_distinct(at.common, cost))
    weight = _weights(coarse, at)
    at, cost = descend(coarse, at, weight, iterations=20)
    cost = cost + _left_out(coarse, weight)
    good = (at.common[:, 2] > 0.0) & np.isfinite(cost)
    good &= in_front(leg.theta1, leg.theta3, at.common)
    if not good.any():
        return None
    cost = np.where(good, cost, np.inf)
    first = int(np.argmin(cost))
    rival = _rival(at.common, cost, first)
    return _finish(leg, Candidates.of(at.common[[first], :BASE], leg), rival)


def _distinct(common: Array, cost: Array) -> NDArray[np.intp]:
    """Return which solutions (S, 3 or more) remain when the same one is kept only once."""
    kept: list[int] = []
    base = common[:, :BASE].tolist()
    for index in np.argsort(cost).tolist():
        if all(_differ(base[index], base[other], _SAME, _SAME) for other in kept):
            kept.append(index)
    return np.array(kept, dtype=np.intp)


def _differ(a: Sequence[float], b: Sequence[float], angle: float, scale: float) -> bool:
    """Return whether two solutions (β, φ1, q) differ by an angle (rad) or a share of the scale."""
    return apart(a, b) > angle or abs(a[2] / b[2] - 1.0) > scale


def _weights(leg: Leg, at: Candidates, minimum: float = MINIMUM_PARALLAX) -> Array:
    """Return 1 for the bearings (S, F, N) that are seen with a parallax over ``minimum``.

    The eight features with the largest parallax are kept in any case.
    """
    parallax = np.abs(np.sin(leg.theta3 - leg.theta1 + at.common[:, 1:2]))
    ranked = np.sort(parallax, axis=1)[:, -min(8, parallax.shape[1]), None]
    well = (parallax >= np.minimum(minimum, ranked))[:, None, :]
    return np.asarray(seen(leg) * well, dtype=np.float64)


def _left_out(leg: Leg, weight: Array) -> Array:
    """Return the cost (S,) of bearings left out: as if they fitted as well as noise does."""
    return np.asarray(0.5 * np.sum(seen(leg) - weight, axis=(1, 2)))


def _rival(common: Array, cost: Array, best: int) -> float:
    """Return by how much the cost of the nearest competitor exceeds the best one."""
    base = common[:, :BASE].tolist()
    others = [
        excess
        for start, excess in zip(base, (cost - cost[best]).tolist(), strict=True)
        if _differ(start, base[best], 0.1, 0.3)
    ]
    return min(others, default=math.inf)


def _finish(leg: Leg, at: Candidates, rival: float) -> LegSolution:
    """Settle on all frames, drop what disagrees, and return the solution with its covariance."""
    weight = _weights(leg, at)
    tested = weight[0].any(axis=0)
    at, _ = descend(leg, at, weight, iterations=10)
    for _ in range(2):
        residual, _, _ = residuals(leg, at)
        weight = weight * (np.abs(residual) < _OUTLIER)
        at, _ = descend(leg, at, weight, iterations=6)
    normal = normal_equations(leg, at, weight)
    frames = seen(leg).sum(axis=0)
    errors = at.errors[0]
    plain = np.abs(errors / np.stack([leg.sigma1, leg.sigma3])).max(axis=0) < _OUTLIER
    used = plain & (weight[0].sum(axis=0) > 0.5 * np.maximum(frames, 1.0))
    last = at.common.shape[1] - 1
    beta, phi, q = at.common[0, :BASE].tolist()
    return LegSolution(
        beta=beta,
        phi=phi,
        q=q,
        turn=float(at.common[0, last]),
        errors=errors,
        covariance=covariance(normal, np.array([0, 1, 2, last])),
        tested=tested,
        used=used,
        cost=float(normal.cost[0]),
        rival=rival,
    )
