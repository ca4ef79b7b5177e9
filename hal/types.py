"""The data that crosses the hardware boundary. SI units and radians everywhere."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Pose(NamedTuple):
    """Planar pose of a camera: x right, y forward (m), φ counter-clockwise from y (rad)."""

    x: float
    y: float
    phi: float


class Velocity(NamedTuple):
    """Forward speed v (m/s) and turning rate ω (rad/s, counter-clockwise)."""

    v: float
    omega: float

    @property
    def finite(self) -> bool:
        """Whether both components are finite numbers."""
        return math.isfinite(self.v) and math.isfinite(self.omega)


STANDSTILL = Velocity(0.0, 0.0)


class Features(NamedTuple):
    """Identified image features, as a camera that solves the correspondence delivers them.

    ids : (N,) int array, strictly increasing; the same id is the same feature in every frame.
    pixels : (N, 2) array, (u, v) in pixels, the centre of the first pixel at (0, 0).
    """

    ids: NDArray[np.int64]
    pixels: NDArray[np.float64]


class Frame(NamedTuple):
    """One picture: a grey image, or identified features, or both.

    stamp : time of exposure on the backend's clock (s).
    sequence : counts up by one per captured frame; a repeated number is a repeated frame.
    image : (height, width) uint8, or None for a camera that delivers features only.
    """

    stamp: float
    sequence: int
    image: NDArray[np.uint8] | None = None
    features: Features | None = None


class Odometry(NamedTuple):
    """Dead-reckoned pose of the base since it was opened, and its measured velocity."""

    stamp: float
    pose: Pose
    velocity: Velocity


class Range(NamedTuple):
    """One reading of a range sensor.

    right, forward : where the sensor sits about the axle's centre (m).
    bearing : in which direction it looks (rad, clockwise from forward).
    distance : to what it meets (m); infinite for nothing.
    age : since it was measured (s).
    """

    right: float
    forward: float
    bearing: float
    distance: float
    age: float = 0.0


class BaseStatus(NamedTuple):
    """Health of the base. ``faults`` are sentences; the robot may move only if it is empty."""

    battery_v: float | None = None
    faults: tuple[str, ...] = ()
