"""Controller plugin ``epipolar-smc``: sliding-mode control from the epipoles of three views.

Step 1 (until τ) brings e23 and e32 to zero along smooth references: the robot ends on the axis of
the target, looking along it. Step 2 removes the depth by e12 → e13 while ω holds the alignment.
All epipoles are for a unit focal length, and so are the gains: those of a law written in pixels
are divided by its αx. q = φ − ψ and ψ are angles of epipolar lines: e23 = tan q, e32 = −tan ψ.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from visctrl.contracts import Context, Controller, Decision, Health, Signal
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.robots.documents import StrictModel
from visctrl.schemes.epipolar.estimate import EpipoleEstimate, EpipolePair
from visctrl.schemes.epipolar.gains import bounded_margins, decoupling_margins, depth_margin

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


class EpipolarSmcOptions(StrictModel):
    """Options of the controller ``epipolar-smc``; the defaults are the published parameters.

    duration_s : time of the whole task; align_fraction of it is step 1.
    lambda_c, lambda_t : pole placement (1/s) of the current and target epipole.
    kappa_c, kappa_t : switching gains (1/s) for a unit focal length (2 px/s at αx = 600).
    k_v_m_s, k_omega_rad_s : inputs of the bounded law.
    k0, k1 : integral and switching gain (1/s) of the depth step.
    threshold_rad : |q| below which the bounded law takes over.
    distance_23_m, distance_12_m : assumed distances, better too long than too short.
    singular_amplitude : amplitude of e23's reference for a start on the singularity.
    unusable_epipole : |e23| above which step 2 turns by the aligned view instead.
    unusable_sd_rad : the same for the standard deviation of its bearing.
    finish_error : |e12 − e13| below which step 2 ends.
    finish_ticks : how many ticks in a row it has to stay there.
    sliding : False leaves plain input–output linearisation, unprotected at the singularity.
    focal_ratio : αx/αe for which the gain conditions are evaluated; it does not act on the law.
    """

    duration_s: Positive = 20.0
    align_fraction: Annotated[float, Field(gt=0, lt=1)] = 0.8
    lambda_c: NotNegative = 2.0
    lambda_t: NotNegative = 1.0
    kappa_c: NotNegative = 2.0 / 600.0
    kappa_t: NotNegative = 2.0 / 600.0
    k_v_m_s: Positive = 0.1
    k_omega_rad_s: Positive = 0.06
    k0: Positive = 1.0
    k1: Positive = 2.0 / 600.0
    threshold_rad: Positive = 0.03
    distance_23_m: Positive = 10.0
    distance_12_m: Positive = 10.0
    singular_amplitude: Positive = 0.15
    unusable_epipole: Positive = 0.15
    unusable_sd_rad: Positive = 0.1
    finish_error: NotNegative = 0.0
    finish_ticks: Annotated[int, Field(ge=1)] = 5
    sliding: bool = True
    focal_ratio: Positive = 1.0


@dataclass(frozen=True)
class _Start:
    """What the first measurement fixes for the run."""

    #: Amplitudes of the references of e23 and e32.
    amplitude_c: float
    amplitude_t: float
    #: −1 with the target ahead (the distance is signed), else 1.
    side: float


class EpipolarSmc(Controller[EpipolarSmcOptions, EpipoleEstimate]):
    """The commuted two-step law (2.10)–(2.19)."""

    Options = EpipolarSmcOptions
    accepts = EpipoleEstimate
    signals = (
        Signal("e23_ref", "1"),
        Signal("e32_ref", "1"),
        Signal("s_c", "1"),
        Signal("s_t", "1"),
        Signal("s_depth", "1"),
        Signal("margin_current", "1/s"),
        Signal("margin_target", "1/s"),
        Signal("margin_v", "m/s"),
        Signal("margin_omega", "rad/s"),
        Signal("margin_depth", "1/s"),
    )

    def __init__(self, options: EpipolarSmcOptions, context: Context) -> None:
        super().__init__(options, context)
        self._start: _Start | None = None
        self._integral = 0.0
        self._t = 0.0
        self._approaching = False
        self._below = 0
        self._values: dict[str, float] = {}

    def values(self) -> Mapping[str, float]:
        """Return the references, the surfaces and the margins of the gain conditions."""
        return self._values

    def update(self, estimate: EpipoleEstimate, sent: Velocity, dt: float) -> Decision:
        """Return the velocity for an estimate; its time is the sum of ``dt`` (s)."""
        self._t += dt
        t = self._t
        self._values = {}
        target = estimate.current_target
        if estimate.health is Health.LOST or target is None or target.health is Health.LOST:
            return Decision(STANDSTILL, "hold", t >= self.options.duration_s)
        if self._start is None:
            if target.health is not Health.OK:
                return Decision(STANDSTILL, "hold", t >= self.options.duration_s)
            self._start = self._begin(target)
        if t <= self.options.align_fraction * self.options.duration_s:
            return self._align(self._start, estimate, target, t)
        return self._approach(self._start, estimate, target, dt)

    # --- step 1 -----------------------------------------------------------------------------

    def _begin(self, target: EpipolePair) -> _Start:
        e23, e32 = target.epipole_a, target.epipole_b
        if abs(math.atan(e23)) <= self.options.threshold_rad:
            amplitude = -math.copysign(self.options.singular_amplitude, e32)
        else:
            # Opposite signs mean a direct motion; equal ones make the robot turn first.
            amplitude = -math.copysign(1.0, e23 * e32) * e23
        ahead = abs(target.bearing_a) <= math.pi / 2.0
        return _Start(amplitude, e32, -1.0 if ahead else 1.0)

    def _reference(self, amplitude: float, t: float) -> tuple[float, float]:
        """Return a reference (2.15) and its rate at ``t``."""
        tau = self.options.align_fraction * self.options.duration_s
        phase = math.pi * t / tau
        half = amplitude / 2.0
        return half * (1.0 + math.cos(phase)), -half * math.pi / tau * math.sin(phase)

    def _align(
        self, start: _Start, estimate: EpipoleEstimate, target: EpipolePair, t: float
    ) -> Decision:
        o = self.options
        reference_c, rate_c = self._reference(start.amplitude_c, t)
        reference_t, rate_t = self._reference(start.amplitude_t, t)
        s_c, s_t = target.epipole_a - reference_c, target.epipole_b - reference_t
        q, psi = math.atan(target.epipole_a), -math.atan(target.epipole_b)
        self._values |= {"e23_ref": reference_c, "e32_ref": reference_t, "s_c": s_c, "s_t": s_t}
        self._report_align(estimate, (s_c, s_t), (rate_c, rate_t), (q, psi))
        if o.sliding and abs(q) <= o.threshold_rad:
            v = -o.k_v_m_s * _sign(-s_t * math.sin(q)) * start.side
            return Decision(Velocity(v, -o.k_omega_rad_s * _sign(s_c)), "align-bounded")
        kappa_c, kappa_t = (o.kappa_c, o.kappa_t) if o.sliding else (0.0, 0.0)
        u_c = rate_c - kappa_c * _sign(s_c) - o.lambda_c * s_c
        u_t = rate_t - kappa_t * _sign(s_t) - o.lambda_t * s_t
        # Without the sliding mode nothing keeps q from zero; the inputs stay numbers all the same.
        sine = math.copysign(max(abs(math.sin(q)), 1e-9), q)
        v = -start.side * o.distance_23_m * math.cos(psi) ** 2 * u_t / sine
        omega = math.cos(q) ** 2 * u_c - math.cos(psi) ** 2 * u_t
        return Decision(Velocity(v, omega), "align")

    # --- step 2 -----------------------------------------------------------------------------

    def _approach(
        self, start: _Start, estimate: EpipoleEstimate, target: EpipolePair, dt: float
    ) -> Decision:
        o = self.options
        over = self._t >= o.duration_s
        omega = -o.k_omega_rad_s * _sign(self._alignment(target, estimate.aligned_current))
        initial, fixed = estimate.initial_current, estimate.initial_target
        if initial is None or fixed is None or not initial.usable(o.unusable_sd_rad):
            return Decision(STANDSTILL, "hold", over)
        error = initial.epipole_a - fixed.epipole_a
        if self._approaching:
            self._integral += error * dt
        self._approaching = True
        s = o.k0 * self._integral + error
        wanted = -o.k0 * error - (o.k1 * _sign(s) if o.sliding else 0.0)
        lever = math.cos(initial.bearing_a) ** 2 / _away_from_zero(
            math.sin(math.atan(initial.epipole_b))
        )
        v = start.side * o.distance_12_m * lever * wanted
        self._values["s_depth"] = s
        self._report_depth(estimate, error)
        self._below = self._below + 1 if abs(error) < o.finish_error else 0
        return Decision(Velocity(v, omega), "depth", over or self._below >= o.finish_ticks)

    def _alignment(self, target: EpipolePair, aligned: EpipolePair | None) -> float:
        """Return the epipole that ω brings to zero (2.19): e23, or e_22ar near the target."""
        usable = target.usable(self.options.unusable_sd_rad)
        if usable and abs(target.epipole_a) <= self.options.unusable_epipole:
            return target.epipole_a
        if aligned is not None and aligned.usable(self.options.unusable_sd_rad):
            return aligned.epipole_b
        return 0.0

    # --- gain conditions --------------------------------------------------------------------

    def _report_align(
        self,
        estimate: EpipoleEstimate,
        surfaces: tuple[float, float],
        rates: tuple[float, float],
        angles: tuple[float, float],
    ) -> None:
        o, location = self.options, estimate.location
        if location is None or location.inverse_distance <= 0.0:
            return
        distance = math.hypot(location.x, location.y) / location.inverse_distance
        if distance <= 0.0:
            return
        if o.sliding and abs(angles[0]) <= o.threshold_rad:
            gains = (o.k_v_m_s, o.k_omega_rad_s)
            bounded = bounded_margins(
                rates, angles, gains, distance=distance, focal_ratio=o.focal_ratio
            )
            self._values |= {"margin_v": float(bounded.v), "margin_omega": float(bounded.omega)}
            return
        margins = decoupling_margins(
            surfaces,
            rates,
            angles,
            (o.kappa_c, o.kappa_t),
            (o.lambda_c, o.lambda_t),
            distance_ratio=o.distance_23_m / distance,
            focal_ratio=o.focal_ratio,
        )
        self._values |= {
            "margin_current": float(margins.current),
            "margin_target": float(margins.target),
        }

    def _report_depth(self, estimate: EpipoleEstimate, error: float) -> None:
        o, location = self.options, estimate.location
        if location is None or location.inverse_distance <= 0.0:
            return
        # Near the target the robot is about as far from the initial view as the target is.
        ratio = o.distance_12_m * location.inverse_distance
        margin = depth_margin(error, o.k0, o.k1, distance_ratio=ratio, focal_ratio=o.focal_ratio)
        self._values["margin_depth"] = float(margin)


def _sign(value: float) -> float:
    return math.copysign(1.0, value) if value != 0.0 else 0.0


def _away_from_zero(value: float) -> float:
    """Return ``value`` kept from zero: e21 = 0 only on the line through the initial view."""
    return math.copysign(max(abs(value), 1e-3), value)
