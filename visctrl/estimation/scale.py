"""Metric scale of a camera's path: what the base was told, against what the camera saw."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hal.types import Velocity
from robots import Limits
from robots.unicycle import step_exact

Array = NDArray[np.float64]

#: The errors of successive frames are alike (they share the fixed views): this many of them
#: count as one.
_ALIKE = 10.0
#: Standard deviation of the delay between a command and its effect (s), before data.
_DELAY_SD_S = 0.15
#: Longest step while the base is ramping (s).
_STEP_S = 0.01


class DeadReckoning:
    """Integrates sent velocities, the base's acceleration ramp included.

    Parameters
    ----------
    limits : Limits or None
        Whose acceleration bounds shape the velocity; None for a base that follows at once.
    offset : float
        Camera ahead of the axle (m).
    """

    def __init__(self, limits: Limits | None, offset: float) -> None:
        self._limits = limits
        self._offset = offset
        self._velocity = (0.0, 0.0)

    def motion(self, sent: Velocity, dt: float) -> Array:
        """Return the camera's motion (3,) in its own frame during ``dt`` seconds under ``sent``."""
        if self._limits is None or dt <= 0.0:
            return step_exact(np.zeros(3), sent.v, sent.omega, max(dt, 0.0), self._offset)
        steps = max(1, math.ceil(dt / _STEP_S))
        step = dt / steps
        bounds = (self._limits.acceleration_m_s2, self._limits.angular_acceleration_rad_s2)
        pose = np.zeros(3)
        for _ in range(steps):
            v, omega = (
                now + max(-bound * step, min(bound * step, goal - now))
                for now, goal, bound in zip(self._velocity, sent, bounds, strict=True)
            )
            self._velocity = (v, omega)
            pose = step_exact(pose, v, omega, step, self._offset)
        return pose


class PathScale:
    """Regresses a path seen in unknown units on the same path dead-reckoned in metres.

    The camera's position p (units) and the dead-reckoned one o (metres, exact) with velocity V
    obey p = κ (o − d V) + noise; d is the unknown delay of the base. κ is found by least
    squares, which the noise of p does not bias, and the scale is 1/κ.
    """

    def __init__(self) -> None:
        self._normal = np.zeros((2, 2))
        self._right = np.zeros(2)

    def update(self, path: Array, velocity: Array, seen: Array, seen_sd: float) -> None:
        """Add one moment: ``path`` (2,) in m, ``velocity`` (2,) in m/s, ``seen`` (2,) in units."""
        columns = np.stack([path, -velocity], axis=-1)
        weight = 1.0 / (_ALIKE * max(seen_sd, 1e-9) ** 2)
        self._normal += weight * columns.T @ columns
        self._right += weight * columns.T @ seen

    def estimate(self) -> tuple[float, float]:
        """Return the scale (m per unit) and its standard deviation, (nan, inf) if unknown."""
        if self._normal[0, 0] <= 0.0 or self._right[0] <= 0.0:
            return math.nan, math.inf
        kappa = self._right[0] / self._normal[0, 0]
        normal = self._normal + np.diag([0.0, 1.0 / (_DELAY_SD_S * kappa) ** 2])
        inverse = np.linalg.inv(normal)
        kappa = float((inverse @ self._right)[0])
        if kappa <= 0.0:
            return math.nan, math.inf
        return 1.0 / kappa, math.sqrt(inverse[0, 0]) / kappa**2
