"""Controller of the final stage: the image is brought to coincide, by turns and straight ways.

Heading and forward error are closed on the spot, in strokes by dead reckoning between looks at
standstill: neither a delay nor a wrong gain can make them swing. A lateral error cannot: the robot
backs up and comes again along a line.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from visctrl.contracts import Context, Controller, Decision, Estimate, Health
from visctrl.hal.types import STANDSTILL, Pose, Velocity
from visctrl.robots.documents import StrictModel
from visctrl.schemes.arrival.estimator import CoincidenceEstimate

#: A look: how long the robot stands before it (s), and over how many ticks it averages.
_SETTLE_S, _TICKS = 1.0, 6
#: Errors that are left as they are: lateral, forward (m), heading (rad).
_LATERAL_M, _FORWARD_M, _HEADING_RAD = 0.004, 0.003, math.radians(0.12)
#: A heading beyond this is closed before anything else.
_TURNED_RAD = math.radians(20.0)
#: How often the robot comes again, and how many strokes it makes in all.
_MANOEUVRES, _STROKES = 4, 30
#: Way back: room for the line (m) beyond what its slope needs.
_ROOM_M, _SLOPE_RAD = 0.5, math.radians(25.0)
#: Gains of the line: heading per lateral error (1/m), forward and backward; turning rate (1/s).
_AHEAD, _BACK, _TURN = 5.0, 4.0, 1.2
#: Fastest and slowest motion (m/s, rad/s), and the gains of a stroke (1/s).
_V, _OMEGA, _LEAST_V, _LEAST_OMEGA = 0.12, math.radians(25.0), 0.008, math.radians(1.5)
_STROKE = 1.5
#: Farther than this from the target (m), by the image or by the way driven, the robot stops; and
#: at a look, turned as at the target, farther than this.
RADIUS_M, _FAR_M = 1.45, 0.6


class CoincideOptions(StrictModel):
    """Options of `Coincide`: none."""


class Coincide(Controller[CoincideOptions, CoincidenceEstimate]):
    """Look, then turn, advance, or back up and come again, until nothing is left."""

    Options: ClassVar[type[CoincideOptions]] = CoincideOptions
    accepts: ClassVar[type[Estimate]] = CoincidenceEstimate

    def __init__(self, options: CoincideOptions, context: Context) -> None:
        super().__init__(options, context)
        self._phase = "look"
        self._stood = 0.0
        self._seen: list[tuple[float, float, float]] = []
        self._manoeuvres = self._strokes = 0
        self._left = self._room = self._driven = 0.0

    def update(self, estimate: CoincidenceEstimate, sent: Velocity, dt: float) -> Decision:
        """Return what to do next; ``sent`` has acted for ``dt`` (s)."""
        if estimate.health is Health.LOST or estimate.left is None:
            return Decision(STANDSTILL, self._phase)
        axle = self._axle(estimate.left.pose)
        self._driven += abs(sent.v) * dt if self._phase == "retreat" else 0.0
        strayed = abs(axle.phi) < 2.0 * _TURNED_RAD and math.hypot(axle.x, axle.y) > RADIUS_M
        if strayed or self._driven > RADIUS_M:
            return Decision(STANDSTILL, "too far off", finished=True)
        if self._phase == "turn":
            return self._stroke(sent.omega * dt, turning=True)
        if self._phase == "advance":
            return self._stroke(sent.v * dt, turning=False)
        if self._phase == "retreat":
            return self._retreat(axle)
        if self._phase == "line":
            return self._line(axle)
        return self._look(axle, sent, dt)

    def _axle(self, camera: Pose) -> Pose:
        """Return the axle's pose about where it is when the camera is at the target."""
        ahead = self.context.camera_forward_m
        right = camera.x + ahead * math.sin(camera.phi)
        return Pose(right, camera.y + ahead * (1.0 - math.cos(camera.phi)), camera.phi)

    def _look(self, axle: Pose, sent: Velocity, dt: float) -> Decision:
        self._stood = self._stood + dt if sent == STANDSTILL else 0.0
        if self._stood < _SETTLE_S:
            self._seen.clear()
            return Decision(STANDSTILL, "look")
        self._seen.append(axle)
        if len(self._seen) < _TICKS:
            return Decision(STANDSTILL, "look")
        x, y, phi = np.median(self._seen, axis=0).tolist()
        self._seen.clear()
        self._stood = 0.0
        return self._choose(x, y, phi)

    def _choose(self, x: float, y: float, phi: float) -> Decision:
        self._strokes += 1
        if self._strokes > _STROKES:
            return Decision(STANDSTILL, "look", finished=True)
        aside = abs(x) > _LATERAL_M and self._manoeuvres < _MANOEUVRES
        if abs(phi) <= _TURNED_RAD and math.hypot(x, y) > _FAR_M:
            return Decision(STANDSTILL, "too far off", finished=True)
        if abs(phi) > (_TURNED_RAD if aside else _HEADING_RAD):
            self._phase, self._left = "turn", -phi
        elif aside:
            self._manoeuvres += 1
            self._phase, self._driven = "retreat", 0.0
            self._room = abs(x) / math.tan(_SLOPE_RAD) + _ROOM_M
        elif abs(y) > _FORWARD_M:
            self._phase, self._left = "advance", -y
        else:
            return Decision(STANDSTILL, "there", finished=True)
        return Decision(STANDSTILL, self._phase)

    def _stroke(self, done: float, *, turning: bool) -> Decision:
        """Go on with a turn or a straight way until it is as long as it should be."""
        self._left -= done
        most, least = (_OMEGA, _LEAST_OMEGA) if turning else (_V, _LEAST_V)
        if abs(self._left) < least * self.context.period_s:
            self._phase = "look"
            return Decision(STANDSTILL, "look")
        rate = math.copysign(min(most, max(least, _STROKE * abs(self._left))), self._left)
        return Decision(Velocity(0.0, rate) if turning else Velocity(rate, 0.0), self._phase)

    def _retreat(self, axle: Pose) -> Decision:
        if axle.y <= -self._room or self._driven > self._room + max(0.0, axle.y) + 0.3:
            self._phase = "line"
            return Decision(STANDSTILL, "line")
        return Decision(Velocity(-_V, _turn_rate(axle, -_BACK)), "retreat")

    def _line(self, axle: Pose) -> Decision:
        if axle.y >= -0.005:
            self._phase = "look"
            return Decision(STANDSTILL, "look")
        speed = min(_V, 0.02 - 0.6 * axle.y)
        return Decision(Velocity(speed, _turn_rate(axle, _AHEAD)), "line")


def _turn_rate(axle: Pose, gain: float) -> float:
    """Return the turning rate towards the line through the target."""
    wanted = min(_SLOPE_RAD, max(-_SLOPE_RAD, gain * axle.x))
    return min(_OMEGA, max(-_OMEGA, _TURN * (wanted - axle.phi)))
