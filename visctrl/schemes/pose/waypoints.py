"""What a Cartesian task is made of: goals, the stages between them, and the time they take."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from visctrl.hal.types import Pose
from visctrl.planning.footprint import along, samples
from visctrl.planning.paths import ParabolicPath, detour, path_between, reachable
from visctrl.robots.documents import StrictModel
from visctrl.robots.unicycle import compose, relative_pose

Array = NDArray[np.float64]
Point = tuple[float, float]


class Goal(StrictModel):
    """An intermediate goal, reached with the heading 0.

    until_s : when it is to be reached, from the start of the path; by its share of the way if
        left out.
    """

    x_m: float
    y_m: float
    until_s: Annotated[float, Field(gt=0.0)] | None = None

    @property
    def place(self) -> Point:
        """(x, y) in the target's frame (m)."""
        return self.x_m, self.y_m


TARGET = Goal(x_m=0.0, y_m=0.0)


class Stage:
    """One path of the control point, from where it was when the stage began.

    Parameters
    ----------
    pose, initial : Pose
        Of the camera, now and at the initial view. The path's start is kept relative to the
        latter, with which it moves when that is estimated better.
    target : Goal
        Where the camera goes.
    camera, lever : float
        Camera and control point ahead of the axle (m).
    straight : float
        Longest straight end of the path (m).

    Attributes
    ----------
    time, tau : float
        Where on the path's timing the stage is, and where that ends (s).
    pace : float
        How fast that time passes; less than 1 where the robot cannot follow.
    """

    def __init__(
        self, pose: Pose, initial: Pose, target: Goal, camera: float, lever: float, straight: float
    ) -> None:
        self.target = target
        self.lever = lever
        self.ahead = lever - camera
        self.tau = self.time = 0.0
        self.pace = 1.0
        self._straight = straight
        point = compose(pose, np.array([0.0, self.ahead, 0.0]))
        self._anchor: tuple[float, ...] = tuple(relative_pose(point, initial).tolist())

    def path(self, initial: Pose) -> ParabolicPath:
        """Return the path as it lies for the present estimate of the initial view."""
        s, c = math.sin(initial.phi), math.cos(initial.phi)
        right, forward, _ = self._anchor
        start = initial.x + c * right - s * forward, initial.y + s * right + c * forward
        forth = math.copysign(1.0, self.target.y_m - start[1])
        goal = self.target.x_m, self.target.y_m + forth * self.ahead
        return path_between(start, goal, self._straight)

    def rest(self, pose: Pose, initial: Pose) -> Array:
        """Return poses (P, 3) of the axle on the rest of the path, from the camera's pose on."""
        path = self.path(initial)
        here = pose.y + self.ahead * math.cos(pose.phi)
        return along(path, pose.phi, self.lever, here, samples(abs(path.goal[1] - here)))


class Waypoints:
    """The goals that are left, and when they are to be reached.

    Parameters
    ----------
    goals : sequence of Goal
        On the way to the target.
    tau : float
        Time for the whole way (s).
    pose : Pose
        Of the camera at its beginning.
    """

    def __init__(self, goals: Sequence[Goal], tau: float, pose: Pose) -> None:
        self._tau = tau
        self._goals: list[Goal] = []
        self._round: list[Goal] = []
        self._taken: Goal | None = None
        self._delayed = False
        here = (pose.x, pose.y)
        for goal in (*goals, TARGET):
            if not reachable(here, goal.place):
                x, y = detour(here, goal.place)
                self._goals.append(Goal(x_m=x, y_m=y))
            self._goals.append(goal)
            here = goal.place
        self._pace = tau / max(sum(_ways(pose, self._goals)), 1e-9)

    @property
    def left(self) -> list[Goal]:
        """All goals that are left; those that lead round obstacles come first."""
        return [*self._round, *self._goals]

    @property
    def aim(self) -> Goal:
        """The next goal that was asked for."""
        return self._goals[0]

    def take(self) -> Goal:
        """Remove and return the next goal."""
        self._taken = None if self._round else self._goals[0]
        return (self._round or self._goals).pop(0)

    def give_up(self, *, under_way: bool) -> None:
        """Forget the way round; ``under_way``: the goal that was taken last is not reached."""
        self._round = []
        self._delayed = True
        if under_way and self._taken is not None:
            self._goals.insert(0, self._taken)
            self._taken = None

    def lead_round(self, places: Sequence[Point]) -> None:
        """Go by some places first."""
        self._round = [Goal(x_m=x, y_m=y) for x, y in places]

    def time_for_next(self, pose: Pose, elapsed: float) -> float:
        """Return the time (s) for the next stage: as asked for, or by its share of what is left."""
        left = self.left
        ways = _ways(pose, left)
        # What a way round has cost is not made up for; other delays are, by half of the time.
        least = (1.0 if self._delayed else 0.5) * self._pace * ways[0]
        if left[0].until_s is not None:
            return max(left[0].until_s - elapsed, least)
        return max((self._tau - elapsed) * ways[0] / max(sum(ways), 1e-9), least)


def _ways(pose: Pose, goals: Sequence[Goal]) -> list[float]:
    """Return the lengths of the stages through some goals (m)."""
    ways, here = [], (pose.x, pose.y)
    for goal in goals:
        ways.append(ParabolicPath(here, goal.place).length)
        here = goal.place
    return ways
