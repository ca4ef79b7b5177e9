"""Controller ``trifocal-super-twisting``: one second-order sliding-mode law for the whole way.

The tensor gives the target's polar coordinates (ρ, q) in the robot's axes and the robot's heading
φ; ψ = φ − q is the direction of the line of sight in the target's frame.

    ρ' = −v cos q / T_N,   ψ' = −v sin q / (T_N ρ),   q' = ω + v sin q / (T_N ρ)

Two outputs are held at zero by the super-twisting algorithm (`visctrl.schemes.super_twisting`):

    s1 = ρ − ρ_d,      s2 = φ − φ_d = q − sat(k ψ),   φ_d = ψ + sat(k ψ)
    v = −(T_N / cos q)(ρ_d' + r1),      ω = −(1 + k) v sin q / (T_N ρ) + r2

On s2 = 0 the line of sight turns with the robot, ψ' = −v sin(k ψ) / (T_N ρ), so that q, ψ and with
them the heading vanish as ρ does: the robot arrives aligned, and there is no second step. Near
the target, where q means nothing, s1 becomes the forward error and s2 the heading, continuously.
The idea is that of Becerra, Hayet and Sagüés, *A single visual-servo controller of mobile robots
with super-twisting control* (2014); outputs, reference and gains are the project's own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, NamedTuple

from pydantic import Field

from visctrl.contracts import Context, Controller, Decision, Estimate, Signal
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.schemes.super_twisting import SuperTwisting
from visctrl.schemes.termination import Arrival, ArrivalOptions, Verdict
from visctrl.schemes.trifocal.estimate import TensorEstimate
from visctrl.schemes.trifocal.law import TrifocalState
from visctrl.schemes.trifocal.law_intake import BLIND_SPEED, Intake

Positive = Annotated[float, Field(gt=0.0)]

#: Cruising speed of a base without limits (m/s), and its share of the limit of one that has.
_IDEAL_CRUISE, _CRUISE_SHARE = 0.4, 0.85
#: Share of the acceleration bound that slowing down asks for.
_ACCELERATION_SHARE = 0.4
#: The reference waits while |s2| is large: its speed goes with cos² of this many times s2.
_CAUTION = 1.2
#: Below this cosine of q the robot only turns: v would have to be more than three times ρ'.
_LEAST_COSINE = 0.3
#: So many standard deviations of the lateral position are no distance to steer by.
_BLUR_SIGMAS = 15.0
#: Greatest disturbances learned: of ρ' as a share of the cruising speed (slip, a wrong T_N), and
#: of q' (rad/s; unequal wheels turn a robot by some hundredths).
_DISTURBED_SHARE, _DRIFT_RAD_S = 0.15, 0.1
#: At the target the horizon is so long that noise asks for no more speed than this (m/s), but at
#: most so many times as long: half of what counts as standing.
_CALM_M_S, _MOST_CALM = 0.003, 4.0


class SuperTwistingOptions(ArrivalOptions):
    """Options of `TrifocalSuperTwisting`, besides `ArrivalOptions`.

    k : how much steeper the robot heads than the line of sight; the path then ends like
        ρ^(k+1) beside the axis.
    steepest_deg : bound of q wanted, sat in s2.
    approach_rate : rate at which the last of the reference's distance goes (1/s).
    gain_distance, integral_distance : λ1 (√m/s) and W1 (m/s²).
    gain_angle, integral_angle : λ2 (√rad/s) and W2 (rad/s²).
    horizon_s : how long the loop takes to answer: period, actuation and what was seen late.
    blend_m : distance at which s1 and s2 are half those of the position, half forward error and
        heading.
    straight_m : on this last part of the way φ_d is bounded in proportion to what is left, so that
        the robot arrives aligned even if not quite on the path.
    settle_m : from this distance on the robot may have arrived.
    """

    k: Annotated[float, Field(ge=1.0, le=4.0)] = 2.0
    steepest_deg: Annotated[float, Field(gt=0.0, le=70.0)] = 50.0
    approach_rate: Positive = 0.7
    gain_distance: Positive = 0.35
    integral_distance: Positive = 0.02
    gain_angle: Positive = 0.8
    integral_angle: Positive = 0.06
    horizon_s: Annotated[float, Field(ge=0.1, le=3.0)] = 0.8
    blend_m: Positive = 0.25
    straight_m: Positive = 0.4
    settle_m: Positive = 0.015


class _Polar(NamedTuple):
    """The target in polar coordinates, metres and rad.

    distance : ρ, negative where the target lies behind: q then counts from the robot's back.
    right, forward : of the target in the robot's axes; beside, along : of it in the target's, the
        robot's distance beside the target's axis and before the target.
    """

    distance: float
    q: float
    forward: float
    right: float
    beside: float
    along: float
    heading: float

    @classmethod
    def of(cls, seen: TrifocalState) -> _Polar:
        right, forward = seen.scale * seen.right, seen.scale * seen.forward
        s, c = math.sin(seen.heading), math.cos(seen.heading)
        sign = 1.0 if forward >= 0.0 else -1.0
        return cls(
            sign * math.hypot(right, forward),
            math.atan2(sign * right, sign * forward),
            forward,
            right,
            s * forward - c * right,
            s * right + c * forward,
            seen.heading,
        )


class TrifocalSuperTwisting(Controller[SuperTwistingOptions, TensorEstimate]):
    """Phases: advance (only where φ1 is not known), sliding, perhaps retreat."""

    Options: ClassVar[type[SuperTwistingOptions]] = SuperTwistingOptions
    accepts: ClassVar[type[Estimate]] = TensorEstimate
    signals: ClassVar[tuple[Signal, ...]] = (
        Signal("distance", "m"),
        Signal("reference", "m"),
        Signal("s_1", "m"),
        Signal("s_2", "rad"),
        Signal("w_1", "m/s"),
        Signal("w_2", "rad/s"),
    )

    def __init__(self, options: SuperTwistingOptions, context: Context) -> None:
        super().__init__(options, context)
        limits = context.limits
        self._cruise, self._slowing = _IDEAL_CRUISE, math.inf
        if limits is not None:
            self._cruise = _CRUISE_SHARE * limits.v_m_s
            self._slowing = 2.0 * _ACCELERATION_SHARE * limits.acceleration_m_s2
        self._along = SuperTwisting(
            options.gain_distance,
            options.integral_distance,
            _DISTURBED_SHARE * self._cruise,
            options.horizon_s,
        )
        self._across = SuperTwisting(
            options.gain_angle, options.integral_angle, _DRIFT_RAD_S, options.horizon_s
        )
        self._arrival = Arrival(options)
        self._intake = Intake(context.camera_forward_m)
        self._reference: float | None = None
        self._retreating = False
        self._wanted = STANDSTILL
        self._values: dict[str, float] = {}

    def update(self, estimate: TensorEstimate, sent: Velocity, dt: float) -> Decision:
        """Return the velocity for an estimate; what was ``sent`` has acted for ``dt`` (s)."""
        self._values = {}
        seen, velocity, advancing = self._intake.read(estimate, sent, dt)
        if seen is None:
            return Decision(velocity, "advance" if advancing else "sliding")
        polar, known = _Polar.of(seen), self._intake.known
        if self._retreating:
            return Decision(self._retreat(polar), "retreat")
        velocity = self._slide(polar, seen.lateral_sd * seen.scale, known, sent)
        if known and abs(polar.distance) < self.options.settle_m + abs(polar.right):
            verdict = self._arrival.judge((polar.right, polar.forward), polar.heading, sent, dt)
            if verdict is Verdict.THERE:
                return Decision(STANDSTILL, "sliding", finished=True)
            self._retreating = verdict is Verdict.BESIDE
        return Decision(velocity, "sliding")

    def values(self) -> Mapping[str, float]:
        """Return distance, reference, outputs and learned disturbances."""
        return self._values

    def _slide(self, polar: _Polar, lateral_sd: float, known: bool, sent: Velocity) -> Velocity:
        """Return the velocity that holds both outputs on their surfaces."""
        options, period = self.options, self.context.period_s
        blend = math.hypot(options.blend_m, _BLUR_SIGMAS * lateral_sd)
        far = polar.distance**2 / (polar.distance**2 + blend**2)
        wanted, slope_gain = self._wanted_heading(polar, blend)
        s_2 = math.remainder(polar.heading - wanted, math.tau)
        position = far * polar.distance + (1.0 - far) * polar.forward
        rate = self._reference_rate(position, s_2, known)
        if self._reference is None:
            self._reference = position
        s_1 = position - self._reference
        free = self._obeyed(sent)
        noisy = lateral_sd / (_CALM_M_S * options.horizon_s)
        stretch = 1.0 + (1.0 - far) * max(0.0, min(_MOST_CALM, noisy) - 1.0)
        r_1 = self._along.step(s_1, period, stretch=stretch, learning=free and known)
        r_2 = self._across.step(s_2, period, stretch=stretch, learning=free)
        self._reference = self._advanced(rate, s_1, period)
        cosine = math.cos(polar.q) * far + (1.0 - far)
        v = -(rate + r_1) / cosine if cosine > _LEAST_COSINE else 0.0
        v = max(-self._cruise, min(self._cruise, v))
        self._wanted = Velocity(v, slope_gain * self._sight_rate(polar, blend, v) + r_2)
        self._values = {
            "distance": polar.distance,
            "reference": self._reference,
            "s_1": s_1,
            "s_2": s_2,
            "w_1": self._along.integral,
            "w_2": self._across.integral,
        }
        return self._wanted

    def _wanted_heading(self, polar: _Polar, blend: float) -> tuple[float, float]:
        """Return φ_d = ψ + sat(k ψ) (rad) and dφ_d/dψ; φ_d fades with the last of the way."""
        options = self.options
        psi = self._sight(polar, blend)
        steepest = math.radians(options.steepest_deg)
        if abs(options.k * psi) < steepest:
            wanted, gain = (1.0 + options.k) * psi, 1.0 + options.k
        else:
            wanted, gain = psi + math.copysign(steepest, psi), 1.0
        left = abs(polar.along) / options.straight_m
        if left < 1.0 and abs(wanted) > left * steepest:
            return math.copysign(left * steepest, wanted), 0.0
        return wanted, gain

    @staticmethod
    def _sight(polar: _Polar, blend: float) -> float:
        """Return ψ (rad), as if never less than ``blend`` (m) of the way were left.

        Near the target noise, or a projection centre that is wrong, turns the line of sight, and
        a robot that turned with it would see it turn more.
        """
        sign = math.copysign(1.0, polar.distance)
        reach = math.copysign(math.hypot(polar.along, blend), polar.along)
        return math.atan2(sign * polar.beside, sign * reach)

    @staticmethod
    def _sight_rate(polar: _Polar, blend: float, v: float) -> float:
        """Return the rate (rad/s) of `_sight` at a speed of v (m/s)."""
        s, c = math.sin(polar.heading), math.cos(polar.heading)
        reach = math.copysign(math.hypot(polar.along, blend), polar.along)
        slope = polar.beside / reach
        return -v * (s - slope * c * polar.along / reach) / reach / (1.0 + slope**2)

    def _reference_rate(self, position: float, s_2: float, known: bool) -> float:
        """Return ρ_d' (m/s): it closes its distance and waits for a robot that must turn first."""
        reference = position if self._reference is None else self._reference
        left = abs(reference)
        top = min(self._cruise, math.sqrt(self._slowing * left), self.options.approach_rate * left)
        if not known:
            top = BLIND_SPEED
        patience = max(math.cos(_CAUTION * s_2), 0.0) ** 2
        return -math.copysign(top * patience, reference)

    def _advanced(self, rate: float, s_1: float, period: float) -> float:
        """Return the reference after a period, never far ahead of what limits let the robot do."""
        assert self._reference is not None
        following = self._reference + rate * period
        leash = 0.5 * self._cruise
        return following if abs(s_1) < leash else following + s_1 - math.copysign(leash, s_1)

    def _obeyed(self, sent: Velocity) -> bool:
        """Return whether the base was told what this law last wanted, not less of it."""
        v, omega = self._wanted
        return abs(sent.v - v) < 0.01 + 0.05 * abs(v) and abs(sent.omega - omega) < 0.03

    def _retreat(self, polar: _Polar) -> Velocity:
        """Return the velocity straight back; the way in begins again from there."""
        if self._arrival.has_room(polar.forward):
            self._retreating = False
            self._reference = None
            self._along.reset()
            self._across.reset()
            self._arrival.restart()
            return STANDSTILL
        return Velocity(-BLIND_SPEED, -1.2 * polar.heading)
