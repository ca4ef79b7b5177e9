"""Controller ``trifocal-smc``: sliding-mode control on the 1D trifocal tensor, in two steps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from visctrl.contracts import Context, Controller, Decision, Estimate, Health, Signal
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.robots import Limits
from visctrl.schemes.sliding_mode import CosineDescent
from visctrl.schemes.termination import Arrival, ArrivalOptions, Divergence, Verdict
from visctrl.schemes.trifocal.estimate import TensorEstimate
from visctrl.schemes.trifocal.initial_heading import InitialHeading
from visctrl.schemes.trifocal.law import (
    Gains,
    Outputs,
    TrifocalState,
    orientation_step,
    position_step,
    settling_step,
    without_spinning,
)

PUBLISHED = Gains(1.0, 2.0, 0.02, 0.02, 0.0, 0.04, 0.0, 0.1, 0.05, 0.3)
PRACTICAL = Gains(1.0, 2.0, 0.02, 0.02, 0.04, 0.0, 0.005, 0.1, 0.05, 1.5)

#: Cruising speed of a base without limits (m/s), and its share of the limit of one that has.
_IDEAL_CRUISE, _CRUISE_SHARE = 0.4, 0.85
#: Share of the acceleration bound that the reference may ask for.
_ACCELERATION_SHARE = 0.7
#: The robot waits this long for the last of the position error (s).
PATIENCE_S = 3.0
#: Damping of the inverse in standard deviations of the lateral position.
DAMPING_SIGMAS = 15.0
#: A start this near to the target, in units of T_N, leaves only a turn to do.
THERE = 1e-3
#: So many times the initial distance away, and so much farther, the robot gives up.
ASTRAY, LEEWAY_M = 1.5, 0.5

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]


class TrifocalSmcOptions(ArrivalOptions):
    """Options of `TrifocalSmc`, besides `ArrivalOptions`. A gain left out is that of ``law``.

    law : ``published`` is the source's, discontinuous; ``practical`` has boundary layers, a
        damped inverse in place of the bounded law, a lateral reference that falls faster than
        the forward one (so the robot stops turning as it arrives), and settles on angles.
    tau_s : duration of step 1; from the distance and the speed limit if left out.
    advance_m, advance_m_s : the straight leg that determines and scales the tensor.
    lateral_power : the lateral reference is the forward one to this power; 1 as published, 3 by
        ``practical``, which reads a φ1 that is only assumed off the straight leg.
    finish : step 2 ends by ``threshold`` (position and heading within tolerance, standing) or
        by ``time`` (after ``orientation_s``, 6/λω if left out).
    """

    law: Literal["practical", "published"] = "practical"
    tau_s: Positive | None = None
    advance_m: NotNegative = 0.2
    advance_m_s: Positive = 0.2
    lateral_power: Annotated[float, Field(ge=1.0, le=5.0)] | None = None
    lambda_1: Positive | None = None
    lambda_2: Positive | None = None
    kappa_1: NotNegative | None = None
    kappa_2: NotNegative | None = None
    boundary_layer: NotNegative | None = None
    threshold: NotNegative | None = None
    damping: NotNegative | None = None
    k_v_m_s: NotNegative | None = None
    k_omega_rad_s: NotNegative | None = None
    lambda_omega: Positive | None = None
    finish: Literal["threshold", "time"] = "threshold"
    orientation_s: Positive | None = None

    def gains(self) -> Gains:
        """Return the gains of the law, with those given here in their place."""
        base = PUBLISHED if self.law == "published" else PRACTICAL
        given = {name: getattr(self, name) for name in Gains._fields}
        return base._replace(**{name: value for name, value in given.items() if value is not None})


class TrifocalSmc(Controller[TrifocalSmcOptions, TensorEstimate]):
    """Phases: advance (straight), position (step 1), orientation (step 2), perhaps retreat."""

    Options: ClassVar[type[TrifocalSmcOptions]] = TrifocalSmcOptions
    accepts: ClassVar[type[Estimate]] = TensorEstimate
    signals: ClassVar[tuple[Signal, ...]] = (
        Signal("reference_xi1", "1"),
        Signal("reference_xi2", "1"),
        Signal("s1", "1"),
        Signal("s2", "1"),
        Signal("determinant", "1"),
        Signal("progress", "s"),
        Signal("tau", "s"),
    )

    def __init__(self, options: TrifocalSmcOptions, context: Context) -> None:
        super().__init__(options, context)
        self._gains = options.gains()
        self._published = options.law == "published"
        self._phase = "advance"
        self._advanced = 0.0
        self._arrival = Arrival(options)
        self._divergence = Divergence(ASTRAY, LEEWAY_M)
        self._initial_heading = InitialHeading()
        self._values: dict[str, float] = {}
        self._progress = self._waited = 0.0

    def update(self, estimate: TensorEstimate, sent: Velocity, dt: float) -> Decision:
        """Return the velocity for an estimate; what was ``sent`` has acted for ``dt`` (s)."""
        self._values = {}
        if estimate.health is Health.LOST:
            return self._hold()
        known = estimate if self._published else self._initial_heading.known(estimate)
        if self._phase == "advance" and not self._starts_there(estimate):
            decision = self._advance(known, sent, dt)
            if decision is not None:
                return decision
        estimate = known or estimate
        if estimate.health is not Health.OK:
            return self._hold()
        seen = TrifocalState.of(estimate, self.context.camera_forward_m)
        self._values = {"determinant": seen.determinant}
        if self._phase == "advance":
            self._begin_position(seen, estimate.scale_sd_m, sent.v)
        if self._divergence.astray(math.hypot(seen.right, seen.forward), seen.scale):
            return self._hold()
        if self._phase == "position":
            wanted = self._position(seen, dt)
        elif self._phase == "retreat":
            wanted = self._retreat(seen)
        else:
            wanted = self._orientation(seen, dt)
            if self._finished(seen, sent, dt):
                return Decision(STANDSTILL, self._phase, finished=True)
        return Decision(wanted, self._phase)

    def values(self) -> Mapping[str, float]:
        """Return references, errors and the clock of step 1."""
        return self._values

    def _hold(self) -> Decision:
        """Stand still; the reference's clock stands still with the robot."""
        return Decision(STANDSTILL, self._phase)

    def _starts_there(self, estimate: TensorEstimate) -> bool:
        """Return whether nothing but a turn is left to do, and go on to that."""
        there = estimate.health is Health.OK and math.hypot(*estimate.outputs) < THERE
        if there:
            self._phase = "orientation"
        return there

    def _advance(
        self, estimate: TensorEstimate | None, sent: Velocity, dt: float
    ) -> Decision | None:
        """Return the next command of the straight leg, None when it is done.

        estimate : None while φ1 has still to be read off the leg.
        """
        if estimate is None:
            return Decision(Velocity(self.options.advance_m_s, 0.0), self._phase)
        self._advanced += sent.v * dt
        left = self.options.advance_m - self._advanced
        if left <= 1e-9 and estimate.health is Health.OK:
            return None
        if left <= -self.options.advance_m:
            # Twice the leg and still no tensor: going on blindly is no remedy.
            return self._hold()
        return Decision(Velocity(self.options.advance_m_s, 0.0), self._phase)

    def _begin_position(self, seen: TrifocalState, scale_sd: float, speed: float) -> None:
        self._phase = "position"
        self._progress = self._waited = 0.0
        self._arrival.restart()
        self._from = (seen.right, seen.forward)
        self._power = self.options.lateral_power or (1.0 if self._published else 3.0)
        away = math.hypot(*self._from)
        self._divergence.begin(away)
        self._reference = descent(
            self.options,
            self.context.limits,
            speed=speed,
            distance=seen.scale * away,
            doubt=scale_sd / seen.scale,
            again=self._arrival.retreats > 0,
        )

    def _position(self, seen: TrifocalState, dt: float) -> Velocity:
        """Return step 1's velocity and advance its clock; step 2 follows when it is over."""
        reference, rate = self._references(seen)
        s_1 = seen.outputs.xi_1 - reference.xi_1
        s_2 = seen.outputs.xi_2 - reference.xi_2
        self._values.update(
            reference_xi1=reference.xi_1,
            reference_xi2=reference.xi_2,
            s1=s_1,
            s2=s_2,
            progress=self._progress,
            tau=self._reference.duration,
        )
        damping = self._gains.damping
        if damping > 0.0:
            damping = max(damping, DAMPING_SIGMAS * seen.lateral_sd)
        wanted = position_step(seen, reference, rate, self._gains._replace(damping=damping))
        if not self._published:
            wanted = without_spinning(wanted)
        # Where the robot is held back by its limits, the reference waits for it.
        self._progress += dt * (1.0 if self._published else self.context.slowdown(wanted))
        if self._progress >= self._reference.duration:
            self._waited += dt
            near = abs(seen.forward) * seen.scale < self.options.tolerance_m
            if self._published or near or self._waited >= PATIENCE_S:
                self._phase, self._waited = "orientation", 0.0
        return wanted

    def _references(self, seen: TrifocalState) -> tuple[Outputs, Outputs]:
        """Return the references of ξ1, ξ2 and their rates (1/s)."""
        level, slope = self._reference.at(self._progress)
        right, forward = self._from
        power = self._power
        b, b_rate = right * level**power, right * power * level ** (power - 1.0) * slope
        a, a_rate = forward * level, forward * slope
        s, c = math.sin(seen.phi_1), math.cos(seen.phi_1)
        return (
            Outputs(c * a + s * b, c * b - s * a),
            Outputs(c * a_rate + s * b_rate, c * b_rate - s * a_rate),
        )

    def _orientation(self, seen: TrifocalState, dt: float) -> Velocity:
        self._waited += dt
        if self._published:
            return orientation_step(seen, self._gains)
        return settling_step(seen, self._gains)

    def _finished(self, seen: TrifocalState, sent: Velocity, dt: float) -> bool:
        """Return whether the robot's own measurements say that it is there (or time is up)."""
        options = self.options
        if options.finish == "time":
            duration = options.orientation_s or 6.0 / self._gains.lambda_omega
            return self._waited >= duration
        place = seen.right * seen.scale, seen.forward * seen.scale
        verdict = self._arrival.judge(place, seen.heading, sent, dt)
        if verdict is Verdict.BESIDE:
            self._phase = "retreat"
        return verdict is Verdict.THERE

    def _retreat(self, seen: TrifocalState) -> Velocity:
        """Return the velocity straight back; step 1 begins again from there."""
        if self._arrival.has_room(seen.forward * seen.scale):
            self._begin_position(seen, scale_sd=0.0, speed=0.0)
            return STANDSTILL
        return Velocity(-self.options.advance_m_s, 0.0)


def descent(
    options: TrifocalSmcOptions,
    limits: Limits | None,
    *,
    speed: float,
    distance: float,
    doubt: float,
    again: bool,
) -> CosineDescent:
    """Return the time course of step 1's reference: as given, or as fast as the limits allow.

    Parameters
    ----------
    speed, distance : float
        Of the robot now (m/s), and to the target (m).
    doubt : float
        Standard deviation of the scale over the scale.
    again : bool
        It comes back from a retreat; ``tau_s`` is for the whole way.
    """
    published = options.law == "published"
    speed, distance = max(speed, 0.0), max(distance, 1e-3)
    if options.tau_s is not None and not again:
        if published:
            return CosineDescent(options.tau_s)
        return CosineDescent.joining(options.tau_s, speed / distance)
    peak = _IDEAL_CRUISE
    if limits is not None:
        bound = math.sqrt(_ACCELERATION_SHARE * limits.acceleration_m_s2 * distance / 2.0)
        peak = min(_CRUISE_SHARE * limits.v_m_s, bound)
    # A scale that may be too small would make the robot faster than meant.
    peak /= 1.0 + min(doubt, 1.0)
    if published or speed >= peak:
        return CosineDescent(math.pi / 2.0 * distance / peak)
    start = math.asin(speed / peak)
    return CosineDescent((math.pi - start) * distance / (peak * (1.0 + math.cos(start))), start)
