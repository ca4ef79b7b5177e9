"""Controller plugin ``epipolar-smooth``: epipolar control in angles, without switching.

With ρ the distance to the target, ψ the direction to it in its own frame and q = φ − ψ the
bearing of the target (angles of epipolar lines), the unicycle obeys

    ρ' = −v cos q,   ψ' = −v sin q/ρ,   q' = ω + v sin q/ρ.

Holding q = kψ makes ψ shrink as ρ^k: position and heading arrive together, on one smooth path and
without a singular decoupling matrix. v = λρ, with a rate λ that ends the motion at a given time
whatever the distance. Where the target is too near for ψ to mean anything, the heading that it
asks for fades to that of the target.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated

import numpy as np
from pydantic import Field

from visctrl.contracts import Context, Controller, Decision, Health, Signal
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.robots.documents import StrictModel
from visctrl.robots.unicycle import wrap_angle
from visctrl.schemes.epipolar.estimate import EpipoleEstimate, Location
from visctrl.schemes.epipolar.manoeuvre import Manoeuvre, ManoeuvreOptions, Polar, polar

Positive = Annotated[float, Field(gt=0)]

#: The approach aims at this part of the task's time; the rest settles what is left.
_APPROACH_PART = 0.9
#: A manoeuvre leaves the approach at least this part of the task's time.
_LEAST_PART = 0.6
#: cos q is not taken smaller than this where the speed would vanish with it.
_LEAST_COSINE = 0.2
#: The scale is trusted once its standard deviation is this part of it.
_KNOWN_SCALE = 0.3
#: Position uncertainties over which the direction fades.
_FADE_SIGMAS = 4.0
#: Slower than this (m/s, rad/s) the robot hardly moves.
_STILL = (0.004, 0.03)
#: The target stays within this part of the camera's field of view.
_FIELD_PART = 0.6


class EpipolarSmoothOptions(StrictModel):
    """Options of the controller ``epipolar-smooth``.

    duration_s : time of the whole task; the robot arrives at nine tenths of it. None drives at a
        constant rate until it is there.
    rate : λ without a duration (1/s).
    max_rate : bound of λ (1/s).
    shape : k, how much faster the direction shrinks than the distance.
    turn_gain : of the heading error (1/s); twice that at the target.
    ramp_s : the approach starts this slowly.
    fade : distance, in units of the first one, below which ψ no longer counts.
    distance_m : rough distance to the target, a bound on the speed until motion has shown it.
    bearing_limit_deg : the target stays within this bearing (perspective cameras: at most
        0.6 of half the field of view).
    tolerance_m, tolerance_deg : without a duration, the task ends when the estimated error stays
        below these while the robot hardly moves, for ``steady_ticks``.
    manoeuvre : the preliminary manoeuvre.
    """

    duration_s: Positive | None = None
    rate: Positive = 0.35
    max_rate: Positive = 1.5
    shape: Positive = 1.2
    turn_gain: Positive = 2.0
    ramp_s: Positive = 1.5
    fade: Positive = 0.004
    distance_m: Positive = 10.0
    bearing_limit_deg: Positive = 57.0
    tolerance_m: Positive = 0.005
    tolerance_deg: Positive = 0.5
    steady_ticks: Annotated[int, Field(ge=1)] = 10
    manoeuvre: ManoeuvreOptions = ManoeuvreOptions()


class EpipolarSmooth(Controller[EpipolarSmoothOptions, EpipoleEstimate]):
    """Manoeuvre where needed, then one smooth approach."""

    Options = EpipolarSmoothOptions
    accepts = EpipoleEstimate
    signals = (
        Signal("distance", "m"),
        Signal("psi", "rad"),
        Signal("bearing", "rad"),
        Signal("heading_error", "rad"),
        Signal("rate", "1/s"),
    )

    def __init__(self, options: EpipolarSmoothOptions, context: Context) -> None:
        super().__init__(options, context)
        self._field = half_field(context.camera)
        self._limit = min(math.radians(options.bearing_limit_deg), _FIELD_PART * self._field)
        self._manoeuvre: Manoeuvre | None = None
        self._begun: float | None = None
        self._steady = 0
        self._t = 0.0
        self._values: dict[str, float] = {}

    def values(self) -> Mapping[str, float]:
        """Return the polar coordinates and the heading error."""
        return self._values

    def update(self, estimate: EpipoleEstimate, sent: Velocity, dt: float) -> Decision:
        """Return the velocity for an estimate; its time is the sum of ``dt`` (s)."""
        self._t += dt
        t = self._t
        self._values = {}
        location = estimate.location
        if estimate.health is Health.LOST or location is None:
            return Decision(STANDSTILL, "hold")
        now = polar(location, self.context.camera_forward_m)
        self._values |= {"distance": now.rho / self._inverse_distance(location), "psi": now.psi}
        if self._manoeuvre is None:
            self._manoeuvre = Manoeuvre(self.options.manoeuvre, now, self._field)
        if not self._manoeuvre.done:
            velocity = self._manoeuvre.update(now, self._inverse_distance(location))
            if not self._manoeuvre.done:
                phase = f"manoeuvre-{self._manoeuvre.kind}"
                return Decision(velocity, phase)
        self._begun = t if self._begun is None else self._begun
        wanted = self._approach(location, now, t - self._begun, self._begun)
        over = self._over(location, now, wanted, t)
        return Decision(STANDSTILL if over else wanted, "approach", over)

    def _approach(self, location: Location, now: Polar, t: float, begun: float) -> Velocity:
        """Return the velocity ``t`` seconds into the approach, which began at ``begun``."""
        o = self.options
        sd = math.sqrt(max(float(location.covariance[0, 0]), 0.0))
        near = max(o.fade, _FADE_SIGMAS * sd)
        fade = now.rho**2 / (now.rho**2 + near**2)
        ahead = max(now.rho * math.cos(now.psi), 0.0) + near
        psi = math.atan2(now.rho * math.sin(now.psi), ahead)
        bent = math.tanh(o.shape * psi / self._limit)
        wanted = fade * (psi + self._limit * bent)
        slope = 1.0 + o.shape * (1.0 - bent**2)
        error = float(wrap_angle(now.phi - wanted))
        # A large heading error is turned away before the robot drives.
        facing = max(0.0, math.cos(1.5 * error)) if abs(error) < 1.0 else 0.0
        rate = self._rate(t, begun) * facing
        q = float(wrap_angle(now.phi - now.psi))
        # Far away the target stays ahead; near it, one that was passed is backed up to.
        rate *= fade * max(math.cos(q), _LEAST_COSINE) + (1.0 - fade) * math.cos(q)
        v = rate * now.rho / self._inverse_distance(location)
        # At the target only the heading is left to settle, and a wrong focal length may shrink it.
        gain = o.turn_gain * (2.0 - fade)
        omega = -slope * fade * rate * math.sin(q) - gain * error
        self._values |= {"bearing": q, "heading_error": error, "rate": rate}
        return Velocity(v, omega)

    def _rate(self, t: float, begun: float) -> float:
        """Return λ after ``t`` seconds of approach: it grows as the time left runs out."""
        o = self.options
        start = min(1.0, t / o.ramp_s)
        if o.duration_s is None:
            return o.rate * start
        duration = max(o.duration_s - begun, _LEAST_PART * o.duration_s)
        left = max(_APPROACH_PART * duration - t, 1e-9)
        return min(o.max_rate, 3.0 / left) * start

    def _over(self, location: Location, now: Polar, wanted: Velocity, t: float) -> bool:
        o = self.options
        if o.duration_s is not None:
            begun = self._begun or 0.0
            return t - begun >= max(o.duration_s - begun, _LEAST_PART * o.duration_s)
        near = now.rho / self._inverse_distance(location) < o.tolerance_m
        still = abs(wanted.v) < _STILL[0] and abs(wanted.omega) < _STILL[1]
        inside = near and still and abs(now.phi) < math.radians(o.tolerance_deg)
        self._steady = self._steady + 1 if inside else 0
        return self._steady >= o.steady_ticks

    def _inverse_distance(self, location: Location) -> float:
        """Return 1/D for the speed: the careful guess until motion has shown it."""
        guess = 1.0 / self.options.distance_m
        sd = math.sqrt(max(float(location.covariance[3, 3]), 0.0))
        known = location.inverse_distance > 0.0 and sd < _KNOWN_SCALE * location.inverse_distance
        return location.inverse_distance if known else max(location.inverse_distance, guess)


def half_field(camera: CentralCamera) -> float:
    """Return half of the camera's horizontal field of view (rad); π for a panoramic one."""
    if camera.panoramic:
        return math.pi
    middle = (camera.height - 1) / 2.0
    rays, valid = camera.robot_rays(np.array([[0.0, middle], [camera.width - 1.0, middle]]))
    bearings = np.abs(np.arctan2(rays[:, 0], rays[:, 1]))
    return float(bearings.min()) if bool(valid.all()) else math.radians(camera.max_polar_deg)
