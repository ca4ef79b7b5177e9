"""The boundary between this project's axes and PyBullet's (REP-103: X forward, Y left, Z up)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.types import Pose

Array = NDArray[np.float64]

#: Turns vectors (x right, y forward, z up) into (X forward, Y left, Z up).
TO_ENGINE: Array = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def heading_matrix(phi: float) -> Array:
    """Return the rotation (3, 3) from robot axes (right, forward, up) at heading φ to the world."""
    s, c = np.sin(phi), np.cos(phi)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def displacement(start: Pose, end: Pose) -> tuple[Array, Array]:
    """Return rotation (3, 3) and shift (3,) that move points of a thing from pose to pose."""
    R = heading_matrix(end.phi - start.phi)
    return R, np.array([end.x, end.y, 0.0]) - R @ np.array([start.x, start.y, 0.0])
