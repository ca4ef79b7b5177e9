"""Where the robot started, from the bearings it saw on a first short leg of known motion.

Maximum a posteriori over all frames of the leg. Unknown are the direction β and heading φ1 of
the start C1 = |C1| (sin β, −cos β, φ1) in the target's frame, the scale q = 1/|C1|, the
deviations ψ of the headings on the way from dead reckoning, and the errors e1, e3 of every
feature's bearing in the two fixed views, whose noise is the same in all frames. Positions are
in units of |C1|; the dead-reckoned motion δ of the leg, in metres, fixes q:

    C2 = C1 + q R(φ1) δ,        θ2 = transfer of (θ1 − e1, θ3 − e3) to C2 + ψ + noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.schemes.pose.first_leg import Leg, apart, binned, in_front, search_starts, seen
from visctrl.schemes.pose.leg_bundle import (
    BASE,
    Candidates,
    covariance,
    descend,
    normal_equations,
    residuals,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

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


@dataclass(frozen=True)
class Start:
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


def solve_leg(leg: Leg, previous: Start | None = None, starts: int = 24) -> Start | None:
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


def _finish(leg: Leg, at: Candidates, rival: float) -> Start:
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
    return Start(
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
