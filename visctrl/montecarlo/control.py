"""The practical trifocal law of many ideal robots: `visctrl.control.trifocal_smc` in arrays."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from visctrl.control.arrival import PATIENCE_S as ARRIVAL_PATIENCE_S
from visctrl.control.arrival import STANDING
from visctrl.control.sliding_mode import CosineDescent
from visctrl.control.trifocal_law import CURVATURE, FREE_TURN
from visctrl.control.trifocal_smc import (
    ASTRAY,
    DAMPING_SIGMAS,
    IDEAL_CRUISE,
    LEEWAY_M,
    PATIENCE_S,
    THERE,
    TrifocalSmcOptions,
)
from visctrl.montecarlo.estimation import Seen

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ADVANCE, POSITION, ORIENTATION = range(3)


class Laws:
    """The law of R robots without limits, as far as it goes without retreats.

    Parameters
    ----------
    count : int
    options : TrifocalSmcOptions
        With ``law`` practical and ``finish`` threshold.
    """

    def __init__(self, count: int, options: TrifocalSmcOptions) -> None:
        self._options, self._gains = options, options.gains()
        self._phase = np.full(count, ADVANCE)
        self._sent = np.zeros((count, 2))
        self._advanced, self._progress, self._waited = np.zeros((3, count)).copy()
        self._from = np.zeros((count, 2))
        self._duration, self._start_angle = np.ones(count), np.zeros(count)
        self._recent = np.zeros((count, options.steady_ticks, 3))
        self._collected = np.zeros(count, dtype=np.int64)
        self._settling = np.zeros(count)
        self.finished = np.zeros(count, dtype=np.bool_)
        #: Robots that need what only the single run has: a retreat, or to be held.
        self.irregular = np.zeros(count, dtype=np.bool_)

    def update(self, seen: Seen, dt: float) -> Array:
        """Return the velocities (R, 2) for what is seen, and set ``finished``."""
        options = self._options
        self.irregular = ~seen.regular
        advancing = self._phase == ADVANCE
        outputs = np.hypot(seen.right, seen.forward)
        there = advancing & (outputs < THERE)
        self._phase = np.where(there, ORIENTATION, self._phase)
        advancing &= ~there
        self._advanced += np.where(advancing, self._sent[:, 0] * dt, 0.0)
        begins = advancing & (options.advance_m - self._advanced <= 1e-9)
        for robot in np.flatnonzero(begins).tolist():
            self._begin(robot, seen)
        advancing &= ~begins
        start = np.hypot(*self._from.T)
        astray = (start > 0.0) & (outputs > ASTRAY * start + LEEWAY_M / seen.scale)
        self.irregular |= astray & ~advancing
        wanted = np.zeros_like(self._sent)
        wanted[advancing, 0] = options.advance_m_s
        settling = self._phase == ORIENTATION
        positioning = self._phase == POSITION
        if positioning.any():
            wanted = np.where(positioning[:, None], self._position(seen, positioning, dt), wanted)
        if settling.any():
            gains = self._gains
            turn = np.stack(
                [seen.scale * gains.lambda_1 * seen.forward, -gains.lambda_omega * seen.heading],
                axis=1,
            )
            wanted = np.where(settling[:, None], turn, wanted)
            self._judge(seen, settling, dt)
        self._sent = wanted
        return wanted

    def _begin(self, robot: int, seen: Seen) -> None:
        """Start step 1 of one robot: as fast as it may, joining on to its present speed."""
        right, forward = float(seen.right[robot]), float(seen.forward[robot])
        scale, scale_sd = float(seen.scale[robot]), float(seen.scale_sd[robot])
        speed = max(float(self._sent[robot, 0]), 0.0)
        distance = max(scale * math.hypot(right, forward), 1e-3)
        if self._options.tau_s is not None:
            descent = CosineDescent.joining(self._options.tau_s, speed / distance)
        else:
            peak = IDEAL_CRUISE / (1.0 + min(scale_sd / scale, 1.0))
            start = math.asin(speed / peak) if speed < peak else 0.0
            reach = math.pi / 2.0
            if speed < peak:
                reach = (math.pi - start) / (1.0 + math.cos(start))
            descent = CosineDescent(reach * distance / peak, start)
        self._phase[robot] = POSITION
        self._from[robot] = right, forward
        self._duration[robot], self._start_angle[robot] = descent.duration, descent.start_angle
        self._progress[robot] = self._waited[robot] = 0.0
        self._collected[robot] = 0

    def _position(self, seen: Seen, which: Mask, dt: float) -> Array:
        gains, power = self._gains, self._options.lateral_power or 3.0
        pace = (math.pi - self._start_angle) / self._duration
        angle = self._start_angle + pace * self._progress
        height = 1.0 + np.cos(self._start_angle)
        over = self._progress >= self._duration
        level = np.where(over, 0.0, (1.0 + np.cos(angle)) / height)
        slope = np.where(over, 0.0, -pace * np.sin(angle) / height)
        right, forward = self._from.T
        # In the robot's axes the outputs are the target's position, whatever φ1 is.
        s, c = np.sin(seen.phi_1), np.cos(seen.phi_1)
        lateral, ahead = right * level**power, forward * level
        s_1 = c * (seen.forward - ahead) + s * (seen.right - lateral)
        s_2 = c * (seen.right - lateral) - s * (seen.forward - ahead)
        lateral_rate, ahead_rate = right * power * level ** (power - 1.0) * slope, forward * slope
        rate_1 = c * ahead_rate + s * lateral_rate
        rate_2 = c * lateral_rate - s * ahead_rate
        rate_1 = rate_1 - gains.kappa_1 * _switching(s_1, gains.boundary_layer)
        rate_2 = rate_2 - gains.kappa_2 * _switching(s_2, gains.boundary_layer)
        rate_1, rate_2 = rate_1 - gains.lambda_1 * s_1, rate_2 - gains.lambda_2 * s_2
        least = DAMPING_SIGMAS if gains.damping > 0.0 else 0.0
        damping = np.maximum(gains.damping, least * seen.lateral_sd)
        forward_rate, right_rate = c * rate_1 - s * rate_2, c * rate_2 + s * rate_1
        omega = right_rate * seen.forward / (seen.forward**2 + damping**2)
        v = -seen.scale * (forward_rate + seen.right * omega)
        most = FREE_TURN + CURVATURE * np.abs(v)
        self._progress += np.where(which, dt, 0.0)
        over = which & (self._progress >= self._duration)
        self._waited += np.where(over, dt, 0.0)
        near = np.abs(seen.forward) * seen.scale < self._options.tolerance_m
        done = over & (near | (self._waited >= PATIENCE_S))
        self._phase = np.where(done, ORIENTATION, self._phase)
        self._waited = np.where(done, 0.0, self._waited)
        return np.stack([v, np.clip(omega, -most, most)], axis=1)

    def _judge(self, seen: Seen, which: Mask, dt: float) -> None:
        """Find out who has arrived: `visctrl.control.arrival.Arrival`."""
        options, count = self._options, self._options.steady_ticks
        moving = (np.abs(self._sent) > np.array(STANDING)).any(axis=1)
        place = np.stack([seen.right * seen.scale, seen.forward * seen.scale, seen.heading], axis=1)
        rolled = np.concatenate([self._recent[:, 1:], place[:, None]], axis=1)
        self._recent = np.where(which[:, None, None], rolled, self._recent)
        collected = np.minimum(np.where(moving, 0, self._collected) + 1, count)
        self._collected = np.where(which, collected, self._collected)
        mean, sd = self._recent.mean(axis=1), self._recent.std(axis=1, ddof=1)
        tolerance = np.array([options.tolerance_m, math.radians(options.tolerance_deg)])
        closing = np.abs(mean[:, 1:])
        steady = which & (self._collected >= count)
        within = (closing <= tolerance).all(axis=1)
        self._settling = np.where(
            steady, np.where(within, self._settling + dt, 0.0), self._settling
        )
        floor = np.maximum(tolerance / 10.0, 2.0 * sd[:, 1:] / math.sqrt(count))
        settled = (closing <= floor).all(axis=1) | (self._settling >= ARRIVAL_PATIENCE_S)
        verdict = steady & within & settled
        beside = np.abs(mean[:, 0]) > options.tolerance_m
        self.finished = verdict & ~beside
        if options.retreats:
            self.irregular |= verdict & beside


def _switching(s: Array, layer: float) -> Array:
    return np.clip(s / layer, -1.0, 1.0) if layer > 0.0 else np.sign(s)
