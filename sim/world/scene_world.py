"""A scene as the emulated robot's surroundings: what its sonar hears and its bumpers touch.

Plan geometry only: walls and items are polygons. It needs no PyBullet.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.types import Pose
from visctrl.robots import Robot
from visctrl.robots.sonar import Transducer
from visctrl.sim.world.scene import Scene, overlap, rectangle, robot_outline

Array = NDArray[np.float64]


class SceneWorld:
    """Surroundings made of a scene's room and items (see `visctrl.hal.emulator.world.World`).

    Parameters
    ----------
    scene : Scene
        In the frame of the emulated robot's poses.
    robot : Robot
        Whose outline touches things.
    """

    def __init__(self, scene: Scene, robot: Robot) -> None:
        self._robot = robot
        (x0, x1), (y0, y1) = scene.room.x_m, scene.room.y_m
        self._low, self._high = np.array([x0, y0]), np.array([x1, y1])
        solid = [item for item in scene.items if item.bottom_m < robot.body.height_m]
        self._outlines = [item.outline() for item in solid]
        self._centres = np.array([item.at_m for item in solid]).reshape(-1, 2)
        self._radii = np.array([math.hypot(*item.size_m[:2]) / 2 for item in solid])
        # What hangs above the ring is not heard.
        height = 0.0 if robot.sonar is None else robot.sonar.height_m
        self._cone = np.array([0.0] if robot.sonar is None else robot.sonar.ray_angles)
        heard = [item.outline() for item in scene.items if item.bottom_m < height]
        walls = rectangle(Pose((x0 + x1) / 2, (y0 + y1) / 2, 0.0), x1 - x0, y1 - y0)
        corners = [walls, *heard]
        self._from = np.concatenate(corners)
        self._to = np.concatenate([np.roll(polygon, -1, axis=0) for polygon in corners])

    def sonar(self, axle: Pose, transducer: Transducer) -> float:
        """Return the distance (m) to what is nearest in the transducer's cone."""
        c, s = math.cos(axle.phi), math.sin(axle.phi)
        ahead, left = transducer.forward_m, transducer.left_m
        origin = np.array([axle.x - s * ahead - c * left, axle.y + c * ahead - s * left])
        angles = axle.phi + transducer.direction_rad + self._cone
        rays = np.stack([-np.sin(angles), np.cos(angles)], axis=-1)
        return self._nearest(origin, rays)

    def blocked(self, axle: Pose) -> bool:
        """Return whether the robot's outline leaves the room or overlaps an item."""
        outline = robot_outline(axle, 0.0, self._robot)
        if (outline < self._low).any() or (outline > self._high).any():
            return True
        reach = self._radii + self._robot.body.radius_m
        distances = np.hypot(*(self._centres - [axle.x, axle.y]).T)
        return any(overlap(outline, self._outlines[i]) for i in np.flatnonzero(distances < reach))

    def _nearest(self, origin: Array, rays: Array) -> float:
        """Return how far the nearest edge is along any of the unit vectors ``rays`` (N, 2)."""
        edge = self._to - self._from
        start = self._from - origin
        across = rays[:, :1] * edge[:, 1] - rays[:, 1:] * edge[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (start[:, 0] * edge[:, 1] - start[:, 1] * edge[:, 0]) / across
            place = (start[:, 0] * rays[:, 1:] - start[:, 1] * rays[:, :1]) / across
            hit = (along >= 0.0) & (place >= 0.0) & (place <= 1.0)
        return float(np.min(along, initial=math.inf, where=hit))
