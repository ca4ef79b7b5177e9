"""Controller ``trifocal-smooth``: one smooth phase that arrives with the target's heading.

The tensor gives the target's position in the robot's axes (the outputs turned by φ1) and the
robot's heading φ, so its lateral position x and its distance d along the target's axis, both in
units of T_N. The paths x = c dⁿ, n > 1, all arrive with the target's heading; they are

    φ_d = atan(n x / d).

φ follows φ_d with its feed-forward, v follows d. Both slow down in proportion to what is left,
so that neither is singular at the target, and nothing is left to turn there: with an imperfect
calibration the bearings of a robot that stands on the target and heads elsewhere are not those
of the target view, and its position looks wrong.

The law needs φ1, which the outputs are turned by. Where the estimate takes it to be 0, it is
read off the tensor's own change on a straight leg.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from visctrl.contracts import Context, Controller, Decision, Estimate, Signal
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.schemes.termination import Arrival, ArrivalOptions, Verdict
from visctrl.schemes.trifocal.estimate import TensorEstimate
from visctrl.schemes.trifocal.law import TrifocalState
from visctrl.schemes.trifocal.law_intake import BLIND_SPEED, Intake

Positive = Annotated[float, Field(gt=0.0)]

#: Cruising speed of a base without limits (m/s), and its share of the limit of one that has.
_IDEAL_CRUISE, _CRUISE_SHARE = 0.4, 0.85
#: Share of the acceleration bound that slowing down asks for.
_ACCELERATION_SHARE = 0.4
#: A start this near to the target, in units of T_N, leaves only a turn to do.
_THERE = 1e-3
#: Distances below this (m), or so many standard deviations of the lateral position, steer as if
#: they were longer: what is noise or the camera's error there must not turn the robot, whose
#: turning would be seen as more of it.
_SHORTEST_M, _BLUR_SIGMAS = 0.25, 15.0
#: Largest heading wanted (rad).
_STEEPEST = 1.2
#: How fast errors of the heading slow the robot down, and from which one on it only turns (rad).
_CAUTION, _TURN_FIRST = 1.2, 1.3
#: The heading's error goes so much faster than the lateral one, at least at this rate (1/s).
_PACE, _LEAST_RATE = 3.0, 0.6


class TrifocalSmoothOptions(ArrivalOptions):
    """Options of `TrifocalSmooth`, besides `ArrivalOptions`.

    power : n, how early the path bends into the target's heading.
    lambda_v : rate at which the last of the distance goes (1/s).
    lambda_omega : highest rate at which the heading's error goes (1/s).
    straight_m : on this last part of the way the heading wanted is bounded in proportion to what
        is left, so that the robot arrives aligned even if not quite on the path.
    settle_m : from this distance on, forward error and heading are closed separately.
    """

    power: Annotated[float, Field(ge=1.0, le=4.0)] = 3.0
    lambda_v: Positive = 0.6
    lambda_omega: Positive = 1.8
    straight_m: Positive = 0.4
    settle_m: Positive = 0.01


class TrifocalSmooth(Controller[TrifocalSmoothOptions, TensorEstimate]):
    """Phases: advance (only where φ1 is not known), approach, settling, perhaps retreat."""

    Options: ClassVar[type[TrifocalSmoothOptions]] = TrifocalSmoothOptions
    accepts: ClassVar[type[Estimate]] = TensorEstimate
    signals: ClassVar[tuple[Signal, ...]] = (
        Signal("lateral", "m"),
        Signal("distance", "m"),
        Signal("heading_wanted", "rad"),
        Signal("heading_error", "rad"),
    )

    def __init__(self, options: TrifocalSmoothOptions, context: Context) -> None:
        super().__init__(options, context)
        self._arrival = Arrival(options)
        self._phase = "approach"
        self._intake = Intake(context.camera_forward_m)
        self._values: dict[str, float] = {}

    def update(self, estimate: TensorEstimate, sent: Velocity, dt: float) -> Decision:
        """Return the velocity for an estimate; what was ``sent`` has acted for ``dt`` (s)."""
        self._values = {}
        seen, velocity, advancing = self._intake.read(estimate, sent, dt)
        if seen is None:
            return Decision(velocity, "advance" if advancing else self._phase)
        known = self._intake.known
        if not self._intake.begun and float(np.hypot(*estimate.outputs)) < _THERE:
            self._intake.begin(seen.scale * math.hypot(seen.right, seen.forward))
            self._phase = "settling"
        if self._phase == "approach":
            wanted = self._approach(seen, known)
        elif self._phase == "settling":
            wanted = self._settle(seen)
            if self._arrived(seen, sent, dt):
                return Decision(STANDSTILL, self._phase, finished=True)
        else:
            wanted = self._retreat(seen)
        return Decision(wanted, self._phase)

    def values(self) -> Mapping[str, float]:
        """Return where the robot is beside and before the target, and its heading's goal."""
        return self._values

    def _approach(self, seen: TrifocalState, known: bool) -> Velocity:
        options = self.options
        s, c = math.sin(seen.heading), math.cos(seen.heading)
        lateral = seen.scale * (s * seen.forward - c * seen.right)
        distance = seen.scale * (s * seen.right + c * seen.forward)
        if known and distance <= options.settle_m:
            self._phase = "settling"
            return self._settle(seen)
        left = max(distance, 0.0)
        ahead = math.hypot(left, max(_SHORTEST_M, _BLUR_SIGMAS * seen.lateral_sd * seen.scale))
        slope = options.power * lateral / ahead
        steepest = _STEEPEST * min(1.0, left / options.straight_m)
        wanted = max(-steepest, min(steepest, math.atan(slope)))
        error = math.remainder(seen.heading - wanted, math.tau)
        self._values = {
            "lateral": lateral,
            "distance": distance,
            "heading_wanted": wanted,
            "heading_error": error,
        }
        top = self._top_speed(left, ahead) if known else BLIND_SPEED
        v = top * max(math.cos(_CAUTION * error), 0.0) ** 2 if abs(error) < _TURN_FIRST else 0.0
        turning = 0.0
        if abs(wanted) < steepest:
            # φ_d' along the way, with x' = −v sin φ and d' = −v cos φ.
            slope_rate = -v * (options.power * s - slope * c * left / ahead) / ahead
            turning = slope_rate / (1.0 + slope**2)
        pace = _PACE * options.power * v / ahead
        rate = max(_LEAST_RATE, min(options.lambda_omega, pace))
        return Velocity(v, turning - rate * error)

    def _top_speed(self, left: float, ahead: float) -> float:
        """Return the speed (m/s) for the distance left, and that with its lower bound."""
        limits, cruise, slowing = self.context.limits, _IDEAL_CRUISE, math.inf
        if limits is not None:
            cruise = _CRUISE_SHARE * limits.v_m_s
            slowing = math.sqrt(2.0 * _ACCELERATION_SHARE * limits.acceleration_m_s2 * ahead)
        return min(cruise, slowing, self.options.lambda_v * left)

    def _settle(self, seen: TrifocalState) -> Velocity:
        """Close forward error and heading, each by its own input."""
        return Velocity(
            self.options.lambda_v * seen.scale * seen.forward,
            -self.options.lambda_omega * seen.heading,
        )

    def _arrived(self, seen: TrifocalState, sent: Velocity, dt: float) -> bool:
        place = seen.right * seen.scale, seen.forward * seen.scale
        verdict = self._arrival.judge(place, seen.heading, sent, dt)
        if verdict is Verdict.BESIDE:
            self._phase = "retreat"
        return verdict is Verdict.THERE

    def _retreat(self, seen: TrifocalState) -> Velocity:
        """Return the velocity straight back; the approach begins again from there."""
        if self._arrival.has_room(seen.forward * seen.scale):
            self._phase = "approach"
            self._arrival.restart()
            return STANDSTILL
        return Velocity(-BLIND_SPEED, -self.options.lambda_omega * seen.heading)
