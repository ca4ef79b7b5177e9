"""The motion that a base really made under what it was told."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from visctrl.hal.types import Velocity
from visctrl.robots import Limits
from visctrl.robots.documents import StrictModel

Array = NDArray[np.float64]
NonNegative = Annotated[float, Field(ge=0.0)]


class MotionNoise(StrictModel):
    """How what a base executes scatters about what it is told, anew in every tick.

    v_m_s, omega_deg_s : standard deviations.
    gain : standard deviation of the odometer's unknown factor (wheel radius, slip).
    """

    v_m_s: NonNegative = 0.002
    omega_deg_s: NonNegative = 0.1
    gain: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0

    def covariance(self, velocity: Velocity) -> Array:
        """Return the covariance M (2, 2) of what is executed about ``velocity``.

        A robot that stands, stands.
        """
        if velocity.v == 0.0 and velocity.omega == 0.0:
            return np.zeros((2, 2))
        return np.diag([self.v_m_s**2, math.radians(self.omega_deg_s) ** 2])


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
