"""What was seen on a first short leg of known motion, and where it may have started.

The search behind `visctrl.schemes.pose.leg_start`: places to begin from, found without any
earlier guess.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.robust.losses import huber
from visctrl.geometry.trifocal.transfer import wrap_half_turn

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Places to begin from are at least so far apart (rad).
_SPREAD = math.radians(15.0)
#: Residuals beyond this many standard deviations pull with constant force.
HUBER = 2.5


@dataclass(frozen=True)
class Leg:
    """What was seen on the first leg.

    theta1, theta3 : (N,) bearings in the initial and the target view (rad).
    sigma1, sigma3 : (N,) their standard deviations.
    motion : (F, 3) camera pose relative to C1 by dead reckoning (m, m, rad).
    turn_variance : (F,) variance of the heading in ``motion`` (rad²), never falling.
    theta2, sigma2 : (F, N) bearings on the way and their standard deviations; NaN where a
        feature was not seen.
    """

    theta1: Array
    theta3: Array
    sigma1: Array
    sigma3: Array
    motion: Array
    turn_variance: Array
    theta2: Array
    sigma2: Array


def seen(leg: Leg) -> Array:
    """Return 1 where a bearing (F, N) was measured and 0 elsewhere."""
    return np.isfinite(leg.theta2).astype(np.float64)


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
