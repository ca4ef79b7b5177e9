"""Controller ``face-target``: turn on the spot until the robot heads at the target."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Self

from pydantic import Field, model_validator

from hal.types import Velocity
from robots.documents import Document
from visctrl.control.shaping import CommandShaper
from visctrl.estimation.estimates import PlanarMotionEstimate
from visctrl.plugins import Context, Controller, Decision, Estimate, Health, Signal

Positive = Annotated[float, Field(gt=0.0)]
Angle = Annotated[float, Field(gt=0.0, lt=180.0)]


class FaceTargetOptions(Document):
    """Options of `FaceTarget`.

    start_deg : a target whose bearing is smaller needs no turn.
    end_deg : bearing under which a turn ends.
    gain_s : turning rate per bearing (1/s).
    omega_deg_s : fastest turn, within the base's own limit; features must stay trackable.
    steady_ticks : for how many ticks in a row the bearing must be small.
    """

    start_deg: Angle = 12.0
    end_deg: Angle = 2.0
    gain_s: Positive = 1.0
    omega_deg_s: Positive = 30.0
    steady_ticks: Annotated[int, Field(ge=1, le=100)] = 3

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.end_deg > self.start_deg:
            raise ValueError("end_deg must not exceed start_deg, or no turn could end")
        return self


class FaceTarget(Controller[FaceTargetOptions, PlanarMotionEstimate]):
    """Proportional turn towards the target, the shorter way round.

    Where the baseline is too short to show a direction the robot stands at the target's
    position already, and there is nothing to turn to.
    """

    Options: ClassVar[type[FaceTargetOptions]] = FaceTargetOptions
    accepts: ClassVar[type[Estimate]] = PlanarMotionEstimate
    signals: ClassVar[tuple[Signal, ...]] = (Signal("bearing", "rad"),)

    def __init__(self, options: FaceTargetOptions, context: Context) -> None:
        super().__init__(options, context)
        self._shaper = CommandShaper(context.limits, whole_units=True)
        self._turning = False
        self._steady = 0
        self._last_t: float | None = None
        self._bearing: float | None = None

    def update(self, estimate: PlanarMotionEstimate, t: float) -> Decision:
        """Return the turning rate for the target's bearing at ``t`` seconds since the start."""
        dt = self.context.period_s if self._last_t is None else max(t - self._last_t, 0.0)
        self._last_t = t
        self._bearing = None
        if estimate.health is Health.LOST:
            return Decision(self._shaper.stop(), "hold")
        undetermined = not math.isfinite(estimate.bearing_sd)
        if estimate.health is Health.DEGENERATE and (undetermined or not self._turning):
            return Decision(self._shaper.stop(), "at the target", finished=not self._turning)
        self._bearing = estimate.bearing
        threshold = self.options.end_deg if self._turning else self.options.start_deg
        if abs(estimate.bearing) < math.radians(threshold):
            return self._facing()
        self._turning = True
        self._steady = 0
        return Decision(self._turn(estimate.bearing, dt), "turn")

    def values(self) -> Mapping[str, float]:
        """Return the target's bearing (clockwise from forward)."""
        return {} if self._bearing is None else {"bearing": self._bearing}

    def _facing(self) -> Decision:
        """Stand, and finish once the bearing has stayed small; at once if there was no turn."""
        self._steady += 1
        done = not self._turning or self._steady >= self.options.steady_ticks
        return Decision(self._shaper.stop(), "facing", finished=done)

    def _turn(self, bearing: float, dt: float) -> Velocity:
        # A bearing is clockwise, a turning rate counter-clockwise.
        bound = math.radians(self.options.omega_deg_s)
        omega = max(-bound, min(bound, -self.options.gain_s * bearing))
        return self._shaper.command(Velocity(0.0, omega), dt)
