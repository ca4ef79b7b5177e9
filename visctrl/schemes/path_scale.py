"""Metric scale of a camera's path: what the base was told, against what the camera saw."""

from __future__ import annotations

import math

from visctrl.hal.actuation import towards
from visctrl.hal.types import Pose, Velocity
from visctrl.robots import Limits
from visctrl.robots.unicycle import along_arc

Point = tuple[float, float]

#: The errors of successive frames are alike (they share the fixed views): this many of them
#: count as one.
ALIKE = 10.0
#: Standard deviation of the delay between a command and its effect (s), before data.
DELAY_SD_S = 0.15
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

    def motion(self, sent: Velocity, dt: float) -> Pose:
        """Return the camera's motion in its own frame during ``dt`` seconds under ``sent``."""
        axle = (0.0, 0.0, 0.0)
        if dt > 0.0:
            axle = self._driven(sent, dt)
        x, y, turn = axle
        offset = self._offset
        return Pose(x - offset * math.sin(turn), y - offset * (1.0 - math.cos(turn)), turn)

    def _driven(self, sent: Velocity, dt: float) -> tuple[float, float, float]:
        """Return the axle's motion, in short steps while it is ramping."""
        pose = (0.0, 0.0, 0.0)
        v, omega = self._velocity
        if self._limits is None or (v, omega) == sent:
            return along_arc(pose, sent, dt)
        steps = max(1, math.ceil(dt / _STEP_S))
        step = dt / steps
        dv = self._limits.acceleration_m_s2 * step
        dw = self._limits.angular_acceleration_rad_s2 * step
        for left in range(steps, 0, -1):
            if (v, omega) == sent:
                pose = along_arc(pose, sent, left * step)
                break
            v, omega = towards(v, sent.v, dv), towards(omega, sent.omega, dw)
            pose = along_arc(pose, (v, omega), step)
        self._velocity = (v, omega)
        return pose


class PathScale:
    """Regresses a path seen in unknown units on the same path dead-reckoned in metres.

    The camera's position p (units) and the dead-reckoned one o (metres, exact) with velocity V
    obey p = κ (o − d V) + noise; d is the unknown delay of the base. κ is found by least
    squares, which the noise of p does not bias, and the scale is 1/κ.
    """

    def __init__(self) -> None:
        # Normal equations of κ and κ d: (n11, n12, n22), and their right-hand side.
        self._normal = (0.0, 0.0, 0.0)
        self._right = (0.0, 0.0)

    def update(self, path: Point, velocity: Point, seen: Point, seen_sd: float) -> None:
        """Add one moment: ``path`` in m, ``velocity`` in m/s, ``seen`` in units, its sd too."""
        (x, y), (vx, vy), (sx, sy) = path, velocity, seen
        weight = 1.0 / (ALIKE * max(seen_sd, 1e-9) ** 2)
        n11, n12, n22 = self._normal
        r1, r2 = self._right
        self._normal = (
            n11 + weight * (x * x + y * y),
            n12 - weight * (x * vx + y * vy),
            n22 + weight * (vx * vx + vy * vy),
        )
        self._right = (r1 + weight * (x * sx + y * sy), r2 - weight * (vx * sx + vy * sy))

    def estimate(self) -> tuple[float, float]:
        """Return the scale (m per unit) and its standard deviation, (nan, inf) if unknown."""
        n11, n12, n22 = self._normal
        r1, r2 = self._right
        if n11 <= 0.0 or r1 <= 0.0:
            return math.nan, math.inf
        n22 += (n11 / (DELAY_SD_S * r1)) ** 2
        determinant = n11 * n22 - n12 * n12
        kappa = (n22 * r1 - n12 * r2) / determinant
        if kappa <= 0.0:
            return math.nan, math.inf
        return 1.0 / kappa, math.sqrt(n22 / determinant) / kappa**2
