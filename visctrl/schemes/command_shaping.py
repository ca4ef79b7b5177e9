"""From a wanted velocity to one that the base can execute."""

from __future__ import annotations

import math

from visctrl.hal.actuation import towards
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.robots import Limits

#: What an ARCOS base takes: whole mm/s and whole deg/s.
V_STEP = 1e-3
OMEGA_STEP = math.radians(1.0)


class CommandShaper:
    """Bounds, ramps and rounds velocities so that the base executes what was decided.

    Both components are scaled together, so a bound slows the robot down and leaves its path.
    Rounding carries its remainder to the next command: on average the base turns by what was
    wanted, however small against 1 deg/s.

    Parameters
    ----------
    limits : Limits or None
        None passes everything on.
    whole_units : bool
        Round to whole mm/s and deg/s (only with limits: an ideal base takes any value).
    """

    def __init__(self, limits: Limits | None, *, whole_units: bool) -> None:
        self._limits = limits
        self._whole_units = whole_units
        self._last = STANDSTILL
        self._carry = [0.0, 0.0]

    def bounded(self, wanted: Velocity) -> tuple[Velocity, float]:
        """Return the velocity within its bounds, and the factor ≤ 1 that brought it there."""
        if self._limits is None:
            return wanted, 1.0
        excess = max(1.0, self._limits.ratio(*wanted))
        return Velocity(wanted.v / excess, wanted.omega / excess), 1.0 / excess

    def command(self, wanted: Velocity, dt: float) -> Velocity:
        """Return what to send for ``wanted`` after ``dt`` seconds of the last command."""
        if self._limits is None:
            return wanted
        bounded, _ = self.bounded(wanted)
        ramped = Velocity(
            towards(self._last.v, bounded.v, self._limits.acceleration_m_s2 * dt),
            towards(self._last.omega, bounded.omega, self._limits.angular_acceleration_rad_s2 * dt),
        )
        self._last = ramped
        return self._rounded(ramped) if self._whole_units else ramped

    def stop(self) -> Velocity:
        """Return standstill; nothing is carried on from before."""
        self._last = STANDSTILL
        self._carry = [0.0, 0.0]
        return STANDSTILL

    def _rounded(self, wanted: Velocity) -> Velocity:
        rounded = []
        for k, step in enumerate((V_STEP, OMEGA_STEP)):
            due = wanted[k] / step + self._carry[k]
            whole = math.floor(due + 0.5)
            self._carry[k] = due - whole
            rounded.append(whole * step)
        return Velocity(*rounded)
