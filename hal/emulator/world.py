"""What the emulated robot can touch and hear."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from visctrl.hal.types import Pose
from visctrl.robots.sonar import Transducer


class World(Protocol):
    """Surroundings of the emulated robot, in the frame of its poses."""

    def sonar(self, axle: Pose, transducer: Transducer) -> float:
        """Return how far (m) the nearest thing in a transducer's cone is; infinite for none."""

    def blocked(self, axle: Pose) -> bool:
        """Return whether the robot would touch something at this pose."""


class OpenSpace:
    """Nothing anywhere."""

    def sonar(self, axle: Pose, transducer: Transducer) -> float:
        """Return infinity."""
        del axle, transducer
        return math.inf

    def blocked(self, axle: Pose) -> bool:
        """Return False."""
        del axle
        return False


@dataclass(frozen=True)
class Room:
    """Four walls, parallel to the axes of the frame (m); the robot is a disc."""

    x_min: float
    x_max: float
    y_min: float
    y_max: float
    radius: float = 0.3

    def sonar(self, axle: Pose, transducer: Transducer) -> float:
        """Return the distance along the transducer's axis to the nearest wall."""
        c, s = math.cos(axle.phi), math.sin(axle.phi)
        x = axle.x - transducer.left_m * c - transducer.forward_m * s
        y = axle.y - transducer.left_m * s + transducer.forward_m * c
        phi = axle.phi + transducer.direction_rad
        along = (
            _ahead(x, -math.sin(phi), self.x_min, self.x_max),
            _ahead(y, math.cos(phi), self.y_min, self.y_max),
        )
        return max(0.0, min(along))

    def blocked(self, axle: Pose) -> bool:
        """Return whether the disc touches a wall."""
        across = min(axle.x - self.x_min, self.x_max - axle.x)
        along = min(axle.y - self.y_min, self.y_max - axle.y)
        return min(across, along) < self.radius


def _ahead(position: float, slope: float, low: float, high: float) -> float:
    """Return how far a ray runs in one coordinate until it leaves [low, high]."""
    if slope == 0.0:
        return math.inf
    return ((high if slope > 0.0 else low) - position) / slope
