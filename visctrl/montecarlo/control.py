"""The practical trifocal law of many robots: `visctrl.schemes.trifocal.law_smc` in arrays."""

from __future__ import annotations

import math

import numpy as np

from visctrl.montecarlo.bases import Shapers, bounded
from visctrl.montecarlo.estimation import Situations
from visctrl.montecarlo.robots import Array, Mask, Robots, Velocities
from visctrl.robots import Limits
from visctrl.schemes.termination import PATIENCE_S as ARRIVAL_PATIENCE_S
from visctrl.schemes.termination import STANDING, ArrivalOptions
from visctrl.schemes.trifocal.law import CURVATURE, FREE_TURN
from visctrl.schemes.trifocal.law_smc import (
    ASTRAY,
    DAMPING_SIGMAS,
    LEEWAY_M,
    PATIENCE_S,
    THERE,
    TrifocalSmcOptions,
    descent,
)

ADVANCE, POSITION, ORIENTATION, RETREAT = range(4)


class Laws(Robots):
    """The laws of R robots.

    Parameters
    ----------
    count : int
    options : TrifocalSmcOptions
        With ``law`` practical, ``finish`` threshold and no ``threshold`` of the determinant.
    limits : Limits or None
        None for ideal robots.

    Attributes
    ----------
    finished : (R,) array
        Whose termination test holds.
    """

    def __init__(self, count: int, options: TrifocalSmcOptions, limits: Limits | None) -> None:
        self._options, self._gains, self._limits = options, options.gains(), limits
        self._shapers = Shapers(count, limits, whole_units=options.whole_units)
        self._sent = Velocities.none(count)
        self._phase = np.full(count, ADVANCE)
        self._advanced, self._progress, self._waited, self._room = np.zeros((4, count)).copy()
        self._from = np.zeros(count), np.zeros(count)
        self._duration, self._start_angle = np.ones(count), np.zeros(count)
        self._retreats = np.zeros(count, dtype=np.intp)
        self._arrivals = Arrivals(count, options)
        self.finished = np.zeros(count, dtype=np.bool_)

    def update(self, seen: Situations, dt: Array) -> Velocities:
        """Return the velocities for what is seen, and set ``finished``."""
        outputs = np.hypot(seen.right, seen.forward)
        self._phase[(self._phase == ADVANCE) & (outputs < THERE)] = ORIENTATION
        wanted = self._advance(seen, dt)
        start = np.hypot(*self._from)
        astray = (start > 0.0) & (outputs > ASTRAY * start + LEEWAY_M / seen.scale)
        settling, retreating = self._phase == ORIENTATION, self._phase == RETREAT
        positioning = (self._phase == POSITION) & ~astray
        if positioning.any():
            wanted = wanted.where(positioning, self._position(seen, positioning, dt))
        if retreating.any():
            wanted = wanted.where(retreating, self._retreat(seen, retreating & ~astray))
        if settling.any():
            gains = self._gains
            closing = seen.scale * gains.lambda_1 * seen.forward
            turn = Velocities(closing, -gains.lambda_omega * seen.heading)
            wanted = wanted.where(settling, turn)
            self._finish(seen, settling & ~astray, dt)
        self._sent = self._shapers.command(wanted, dt)
        halted = astray | self.finished
        if halted.any():
            self._shapers.stop(halted)
            self._sent = self._sent.only(~halted)
        return self._sent

    def _advance(self, seen: Situations, dt: Array) -> Velocities:
        """Return the velocities of the straight leg; those that have done it begin step 1."""
        options = self._options
        advancing = self._phase == ADVANCE
        self._advanced += np.where(advancing, self._sent.v * dt, 0.0)
        done = advancing & (options.advance_m - self._advanced <= 1e-9)
        for robot in np.flatnonzero(done).tolist():
            self._begin(robot, seen, float(seen.scale_sd[robot]))
        ahead = np.where(advancing & ~done, options.advance_m_s, 0.0)
        return Velocities(ahead, np.zeros_like(ahead))

    def _begin(self, robot: int, seen: Situations, scale_sd: float) -> None:
        """Start step 1 of one robot, from where it is."""
        right, forward = float(seen.right[robot]), float(seen.forward[robot])
        scale = float(seen.scale[robot])
        course = descent(
            self._options,
            self._limits,
            speed=float(self._sent.v[robot]),
            distance=scale * math.hypot(right, forward),
            doubt=scale_sd / scale,
            again=bool(self._retreats[robot] > 0),
        )
        self._phase[robot] = POSITION
        self._from[0][robot], self._from[1][robot] = right, forward
        self._duration[robot], self._start_angle[robot] = course.duration, course.start_angle
        self._progress[robot] = self._waited[robot] = 0.0
        self._arrivals.forget(robot)

    def _position(self, seen: Situations, which: Mask, dt: Array) -> Velocities:
        """Return the velocities of step 1, and advance its clock; step 2 follows."""
        wanted = self._tracking(seen)
        most = FREE_TURN + CURVATURE * np.abs(wanted.v)
        wanted = wanted._replace(omega=np.clip(wanted.omega, -most, most))
        # Where a robot is held back by its limits, the reference waits for it.
        self._progress += np.where(which, dt * bounded(wanted, self._limits)[1], 0.0)
        over = which & (self._progress >= self._duration)
        if over.any():
            self._waited += np.where(over, dt, 0.0)
            near = np.abs(seen.forward) * seen.scale < self._options.tolerance_m
            done = over & (near | (self._waited >= PATIENCE_S))
            self._phase[done], self._waited[done] = ORIENTATION, 0.0
        return wanted

    def _tracking(self, seen: Situations) -> Velocities:
        """Return what tracks the references (3.7)–(3.10), in the robots' axes.

        There the outputs are the target's position, whatever φ1 is.
        """
        gains, power = self._gains, self._options.lateral_power or 3.0
        level, slope = self._reference()
        right, forward = self._from
        s, c = np.sin(seen.phi_1), np.cos(seen.phi_1)
        ahead, aside = seen.forward - forward * level, seen.right - right * level**power
        s_1, s_2 = c * ahead + s * aside, c * aside - s * ahead
        rate_1 = -gains.kappa_1 * _switching(s_1, gains.boundary_layer) - gains.lambda_1 * s_1
        rate_2 = -gains.kappa_2 * _switching(s_2, gains.boundary_layer) - gains.lambda_2 * s_2
        forward_rate = c * rate_1 - s * rate_2 + forward * slope
        right_rate = c * rate_2 + s * rate_1 + right * power * level ** (power - 1.0) * slope
        least = DAMPING_SIGMAS if gains.damping > 0.0 else 0.0
        damping = np.maximum(gains.damping, least * seen.lateral_sd)
        omega = right_rate * seen.forward / (seen.forward**2 + damping**2)
        return Velocities(-seen.scale * (forward_rate + seen.right * omega), omega)

    def _reference(self) -> tuple[Array, Array]:
        """Return the references and their rates: see `sliding_mode.CosineDescent.at`."""
        pace = (math.pi - self._start_angle) / self._duration
        angle = self._start_angle + pace * self._progress
        height, under_way = 1.0 + np.cos(self._start_angle), self._progress < self._duration
        level = np.where(under_way, (1.0 + np.cos(angle)) / height, 0.0)
        return level, np.where(under_way, -pace * np.sin(angle) / height, 0.0)

    def _retreat(self, seen: Situations, which: Mask) -> Velocities:
        """Return the velocities straight back; step 1 begins again from far enough."""
        far = which & (seen.forward * seen.scale >= self._room)
        self._sent = self._sent.only(~far)
        for robot in np.flatnonzero(far).tolist():
            self._begin(robot, seen, 0.0)
        return Velocities(np.where(far, 0.0, -self._options.advance_m_s), np.zeros(len(far)))

    def _finish(self, seen: Situations, which: Mask, dt: Array) -> None:
        """Find out who is there, and who is beside the target and has to come again."""
        options = self._options
        place = np.stack([seen.right * seen.scale, seen.forward * seen.scale, seen.heading], 1)
        settled, lateral = self._arrivals.judge(place, self._sent, dt, which)
        beside = np.abs(lateral) > options.tolerance_m
        self.finished = settled & ~beside
        again = settled & beside & (self._retreats < options.retreats)
        if again.any():
            self._retreats += again
            self._phase[again] = RETREAT
            least = options.retreat_m
            room = np.minimum(np.maximum(least, 6.0 * np.abs(lateral)), 3.0 * least)
            self._room = np.where(again, room, self._room)


class Arrivals(Robots):
    """The ends of R drives: see `visctrl.schemes.termination.Arrival`."""

    def __init__(self, count: int, options: ArrivalOptions) -> None:
        self._options = options
        self._recent = np.zeros((count, options.steady_ticks, 3))
        self._collected = np.zeros(count, dtype=np.intp)
        self._waited = np.zeros(count)

    def forget(self, robot: int) -> None:
        """Begin anew with one robot."""
        self._collected[robot], self._waited[robot] = 0, 0.0

    def judge(self, place: Array, sent: Velocities, dt: Array, which: Mask) -> tuple[Mask, Array]:
        """Return who of ``which`` has settled, and the mean lateral errors (R,) in m.

        place : (R, 3), the target to the right and ahead of the robot (m), and the heading (rad).
        """
        options, count = self._options, self._options.steady_ticks
        moving = (np.abs(sent.v) > STANDING.v) | (np.abs(sent.omega) > STANDING.omega)
        collected = np.minimum(np.where(moving, 0, self._collected) + 1, count)
        self._collected = np.where(which, collected, self._collected)
        self._recent[which] = np.concatenate([self._recent[which, 1:], place[which, None]], axis=1)
        mean, sd = self._recent.mean(axis=1), self._recent.std(axis=1, ddof=1)
        tolerance = np.array([options.tolerance_m, math.radians(options.tolerance_deg)])
        closing, steady = np.abs(mean[:, 1:]), which & (self._collected >= count)
        within = (closing <= tolerance).all(axis=1)
        self._waited = np.where(steady, np.where(within, self._waited + dt, 0.0), self._waited)
        floor = np.maximum(tolerance / 10.0, 2.0 * sd[:, 1:] / math.sqrt(count))
        settled = (closing <= floor).all(axis=1) | (self._waited >= ARRIVAL_PATIENCE_S)
        return steady & within & settled, mean[:, 0]


def _switching(s: Array, layer: float) -> Array:
    return np.clip(s / layer, -1.0, 1.0) if layer > 0.0 else np.sign(s)
