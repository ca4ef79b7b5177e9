"""Controller ``face-target``: turn on the spot until the target lies straight ahead."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar

from pydantic import Field

from hal.types import STANDSTILL, Velocity
from robots.documents import Document
from visctrl.control.shaping import CommandShaper
from visctrl.estimation.estimates import PlanarMotionEstimate
from visctrl.plugins import Context, Controller, Decision, Estimate, Health, Signal

Degrees = Annotated[float, Field(gt=0.0, le=180.0)]
#: A robot told to turn slower than this (rad/s) counts as standing.
_STANDING = math.radians(1.5)


class FaceTargetOptions(Document):
    """Options of `FaceTarget`.

    start_deg : a target no further off the heading than this is good enough from the start.
    stop_deg : how far off it may be in the end.
    gain : turning rate over bearing (1/s).
    omega_deg_s : fastest turn, so that features can be followed.
    steady_ticks : for how many ticks the end must hold.
    """

    start_deg: Degrees = 12.0
    stop_deg: Degrees = 1.5
    gain: Annotated[float, Field(gt=0.0)] = 1.2
    omega_deg_s: Annotated[float, Field(gt=0.0)] = 25.0
    steady_ticks: Annotated[int, Field(ge=1)] = 3


class FaceTarget(Controller[FaceTargetOptions, PlanarMotionEstimate]):
    """Turns towards the target the shorter way round, and keeps to that way.

    Near 180° noise would make the shorter way change from tick to tick; once the robot turns,
    the bearing is unwrapped, so it goes on. Where target and current position coincide there is
    nothing to face: it finishes at once.
    """

    Options: ClassVar[type[FaceTargetOptions]] = FaceTargetOptions
    accepts: ClassVar[type[Estimate]] = PlanarMotionEstimate
    signals: ClassVar[tuple[Signal, ...]] = (Signal("unwrapped_bearing", "rad"),)

    def __init__(self, options: FaceTargetOptions, context: Context) -> None:
        super().__init__(options, context)
        self._shaper = CommandShaper(context.limits, whole_units=True)
        self._bearing: float | None = None
        self._last_t: float | None = None
        self._sent = STANDSTILL
        self._steady = 0

    def update(self, estimate: PlanarMotionEstimate, t: float) -> Decision:
        """Return the turning rate for an estimate at ``t`` seconds since the start."""
        dt = self.context.period_s if self._last_t is None else max(t - self._last_t, 0.0)
        self._last_t = t
        if estimate.health is not Health.OK:
            self._sent = self._shaper.stop()
            # Degenerate with a known rotation: the robot is where the target was taken.
            nowhere = estimate.health is Health.DEGENERATE and self._bearing is None
            at_target = nowhere and math.isfinite(estimate.motion.phi_sd)
            return Decision(STANDSTILL, "face target", finished=at_target)
        first = self._bearing is None
        bearing = self._unwrapped(estimate.bearing, dt)
        options = self.options
        if first and abs(bearing) <= math.radians(options.start_deg):
            return Decision(STANDSTILL, "face target", finished=True)
        # Bearings grow clockwise, turning rates counter-clockwise.
        top = math.radians(options.omega_deg_s)
        omega = max(-top, min(top, -options.gain * bearing))
        aligned = abs(bearing) <= math.radians(options.stop_deg)
        standing = abs(self._sent.omega) <= _STANDING
        self._steady = self._steady + 1 if aligned and standing else 0
        if self._steady >= options.steady_ticks:
            return Decision(self._shaper.stop(), "face target", finished=True)
        self._sent = self._shaper.command(Velocity(0.0, omega), dt)
        return Decision(self._sent, "face target")

    def values(self) -> Mapping[str, float]:
        """Return the bearing that is being closed."""
        return {} if self._bearing is None else {"unwrapped_bearing": self._bearing}

    def _unwrapped(self, bearing: float, dt: float) -> float:
        """Return ``bearing`` plus the whole turns that bring it nearest to the expected one."""
        if self._bearing is not None:
            expected = self._bearing + self._sent.omega * dt
            bearing += 2.0 * math.pi * round((expected - bearing) / (2.0 * math.pi))
        self._bearing = bearing
        return bearing
