"""Obstacles: how they come to be known, and intermediate goals that lead round them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hal.types import Pose, Range
from robots.documents import Document
from robots.errors import InputError
from visctrl.control.paths import path_between, reachable

Array = NDArray[np.float64]
Positive = Annotated[float, Field(gt=0.0)]
Point = tuple[float, float]

#: Places tried for an intermediate goal: beside the obstacle, in units of the clearance.
_ASIDE = (1.05, 1.3, 1.6, 2.0, 2.6, 3.4)
_ALONG = (0.0, 0.5, -0.5, 1.0, -1.0, 1.6, 2.4)
#: Two echoes nearer than this (m) are one obstacle.
_SAME_M = 0.15
#: Radius (m) that an echo stands for.
_ECHO_RADIUS_M = 0.1


@dataclass(frozen=True)
class Obstacle:
    """A disc on the floor, in the target's frame (m)."""

    x: float
    y: float
    radius: float

    def distance(self, points: Array) -> Array:
        """Return the distance (...) of points (..., 2) from the disc's edge (m)."""
        away = np.hypot(points[..., 0] - self.x, points[..., 1] - self.y)
        return np.asarray(away - self.radius, dtype=np.float64)


class ListedObstacle(Document):
    """An obstacle of which the robot learns when it comes near.

    x_m, y_m, radius_m : in the target's frame.
    noticed_m : distance of the camera from its edge at which it is noticed.
    """

    x_m: float
    y_m: float
    radius_m: Positive = 0.3
    noticed_m: Positive = 2.0

    @property
    def obstacle(self) -> Obstacle:
        """The obstacle itself."""
        return Obstacle(self.x_m, self.y_m, self.radius_m)


class ObstacleProvider(ABC):
    """A source of obstacles."""

    @abstractmethod
    def noticed(self, pose: Pose, ranges: Sequence[Range]) -> list[Obstacle]:
        """Return all obstacles noticed so far.

        pose : estimated camera pose in the target's frame (m, m, rad).
        ranges : what the range sensors say now.
        """


class ListedObstacles(ObstacleProvider):
    """Obstacles of a scenario, each noticed from its own distance."""

    def __init__(self, listed: Sequence[ListedObstacle]) -> None:
        self._ahead = list(listed)
        self._noticed: list[Obstacle] = []

    def noticed(self, pose: Pose, ranges: Sequence[Range]) -> list[Obstacle]:
        """Return those that the camera has been near enough to (see the contract)."""
        del ranges
        here = np.array(pose[:2])
        for known in list(self._ahead):
            if known.obstacle.distance(here) <= known.noticed_m:
                self._ahead.remove(known)
                self._noticed.append(known.obstacle)
        return list(self._noticed)


class EchoedObstacles(ObstacleProvider):
    """Obstacles that range sensors meet; each echo is a small disc where it came from.

    Parameters
    ----------
    reach : float
        Longer ranges are not believed (m).
    camera_forward : float
        Camera ahead of the axle, from which ranges are measured (m).
    """

    def __init__(self, reach: float, camera_forward: float) -> None:
        self._reach = reach
        self._forward = camera_forward
        self._noticed: list[Obstacle] = []

    def noticed(self, pose: Pose, ranges: Sequence[Range]) -> list[Obstacle]:
        """Return every place that sent an echo so far (see the contract)."""
        s, c = math.sin(pose.phi), math.cos(pose.phi)
        for echo in ranges:
            if not echo.distance < self._reach:
                continue
            right = echo.right + (echo.distance + _ECHO_RADIUS_M) * math.sin(echo.bearing)
            forward = echo.forward + (echo.distance + _ECHO_RADIUS_M) * math.cos(echo.bearing)
            forward -= self._forward
            x, y = pose.x + c * right - s * forward, pose.y + s * right + c * forward
            if all(math.dist((x, y), (o.x, o.y)) > _SAME_M for o in self._noticed):
                self._noticed.append(Obstacle(x, y, _ECHO_RADIUS_M))
        return list(self._noticed)


def refuse_blocked(
    goals: Mapping[str, Point], listed: Sequence[ListedObstacle], clearance: float
) -> None:
    """Raise InputError where a goal, by name, is too near an obstacle of the scenario."""
    for k, each in enumerate(listed):
        for name, goal in goals.items():
            free = float(each.obstacle.distance(np.array(goal)))
            if free < clearance:
                raise InputError(
                    f"controller.obstacles.{k}: {name} is {max(free, 0.0):.2f} m from its edge "
                    f"and needs {clearance:g} m (controller.clearance_m)"
                )


def blocking(points: Array, obstacles: Sequence[Obstacle], clearance: float) -> list[Obstacle]:
    """Return the obstacles that a way (K, 2) passes nearer than ``clearance`` (m).

    An obstacle that is too near already blocks only a way that comes nearer still.
    """
    found = []
    for obstacle in obstacles:
        distance = obstacle.distance(points)
        if distance.min() < min(clearance, float(distance[0]) - 0.02):
            found.append(obstacle)
    return found


def way_round(
    here: Point, goal: Point, obstacles: Sequence[Obstacle], clearance: float, straight: float
) -> Point | None:
    """Return the intermediate goal of the shortest clear way to a goal, None if there is none.

    Both parts are paths that end along the y axis, as the tracker drives them (`path_between`).

    Parameters
    ----------
    here, goal : (x, y) in the target's frame (m).
    obstacles : sequence of Obstacle
    clearance : float
        Of the camera's path from an obstacle's edge (m).
    straight : float
        Straight end of each path (m).
    """
    direct = path_between(here, goal, straight).points()
    in_the_way = blocking(direct, obstacles, clearance)
    best, shortest = None, math.inf
    for obstacle, aside, along, side in product(in_the_way, _ASIDE, _ALONG, (-1.0, 1.0)):
        reach = obstacle.radius + clearance
        between = (obstacle.x + side * aside * reach, obstacle.y + along * reach)
        if not (reachable(here, between) and reachable(between, goal)):
            continue
        first = path_between(here, between, straight)
        second = path_between(between, goal, straight)
        length = first.length + second.length
        if length >= shortest or blocking(first.points(), obstacles, clearance):
            continue
        if not blocking(second.points(), obstacles, clearance):
            best, shortest = between, length
    return best
