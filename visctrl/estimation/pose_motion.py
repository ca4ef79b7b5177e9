"""The velocity that a base really had under what it was told."""

from __future__ import annotations

from hal.types import Velocity
from robots import Limits


class RampedVelocity:
    """Mean velocity of each tick, the base's acceleration ramp included.

    Parameters
    ----------
    limits : Limits or None
        Whose acceleration bounds shape the velocity; None for a base that follows at once.
    """

    def __init__(self, limits: Limits | None) -> None:
        self._limits = limits
        self._now = Velocity(0.0, 0.0)

    def during(self, sent: Velocity, dt: float) -> Velocity:
        """Return the mean velocity of ``dt`` seconds under ``sent``."""
        if self._limits is None or dt <= 0.0:
            self._now = sent
            return sent
        v_bound = self._limits.acceleration_m_s2
        omega_bound = self._limits.angular_acceleration_rad_s2
        v, v_end = _ramp(self._now.v, sent.v, v_bound, dt)
        omega, omega_end = _ramp(self._now.omega, sent.omega, omega_bound, dt)
        self._now = Velocity(v_end, omega_end)
        return Velocity(v, omega)


def _ramp(start: float, goal: float, bound: float, dt: float) -> tuple[float, float]:
    """Return mean and final value of a ramp from ``start`` to ``goal`` at the rate ``bound``."""
    change = goal - start
    ramp = min(abs(change) / bound, dt)
    end = goal if ramp < dt else start + (bound if change > 0.0 else -bound) * dt
    return (0.5 * (start + end) * ramp + end * (dt - ramp)) / dt, end
