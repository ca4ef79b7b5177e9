"""Controller ``face-target``: turn on the spot until the target lies straight ahead."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Self

from pydantic import Field, model_validator

from visctrl.contracts import Context, Controller, Decision, Estimate, Health, Signal
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.robots.documents import StrictModel
from visctrl.schemes.trifocal.estimate import PlanarMotionEstimate

Positive = Annotated[float, Field(gt=0.0)]
Angle = Annotated[float, Field(gt=0.0, lt=180.0)]
#: A robot told to turn slower than this (rad/s) counts as standing.
STANDING = math.radians(1.5)


class FaceTargetOptions(StrictModel):
    """Options of `FaceTarget`.

    start_deg : a target whose bearing is smaller needs no turn.
    end_deg : bearing under which a turn ends.
    gain_s : turning rate per bearing (1/s).
    omega_deg_s : fastest turn, within the base's own limit; features must stay trackable.
    steady_ticks : for how many ticks in a row the bearing must be small, the robot standing.
    """

    start_deg: Angle = 12.0
    end_deg: Angle = 1.5
    gain_s: Positive = 1.2
    omega_deg_s: Positive = 30.0
    steady_ticks: Annotated[int, Field(ge=1, le=100)] = 3

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.end_deg > self.start_deg:
            raise ValueError("end_deg must not exceed start_deg, or no turn could end")
        return self


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
        self._bearing: float | None = None
        self._steady = 0

    def update(self, estimate: PlanarMotionEstimate, sent: Velocity, dt: float) -> Decision:
        """Return the turning rate for the target's bearing; ``sent`` has acted for ``dt`` (s)."""
        if estimate.health is not Health.OK:
            return self._without_bearing(estimate)
        turning = self._bearing is not None
        bearing = self._unwrapped(estimate.bearing, sent.omega * dt)
        if not turning and abs(bearing) <= math.radians(self.options.start_deg):
            return Decision(STANDSTILL, "facing", finished=True)
        aligned = abs(bearing) <= math.radians(self.options.end_deg)
        standing = abs(sent.omega) <= STANDING
        self._steady = self._steady + 1 if aligned and standing else 0
        if self._steady >= self.options.steady_ticks:
            return Decision(STANDSTILL, "facing", finished=True)
        # A bearing is clockwise, a turning rate counter-clockwise.
        bound = math.radians(self.options.omega_deg_s)
        omega = max(-bound, min(bound, -self.options.gain_s * bearing))
        return Decision(Velocity(0.0, omega), "turn")

    def values(self) -> Mapping[str, float]:
        """Return the bearing that is being closed."""
        return {} if self._bearing is None else {"unwrapped_bearing": self._bearing}

    def _without_bearing(self, estimate: PlanarMotionEstimate) -> Decision:
        """Stand; finish where the robot has not turned and the views differ by a turn at most."""
        if estimate.health is Health.LOST:
            return Decision(STANDSTILL, "hold")
        return Decision(STANDSTILL, "at the target", finished=self._bearing is None)

    def _unwrapped(self, bearing: float, turned: float) -> float:
        """Return ``bearing`` plus the whole turns that bring it nearest to the expected one.

        turned : how far the robot was told to turn since the last one (rad).
        """
        if self._bearing is not None:
            expected = self._bearing + turned
            bearing += 2.0 * math.pi * round((expected - bearing) / (2.0 * math.pi))
        self._bearing = bearing
        return bearing
