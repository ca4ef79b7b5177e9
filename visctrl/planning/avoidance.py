"""Stopping before obstacles, looking, planning a way round, backing off."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from visctrl.contracts import Context, Decision, Obstacle
from visctrl.hal.types import STANDSTILL, Pose, Velocity
from visctrl.planning.detours import WayFinder
from visctrl.planning.footprint import Footprint, moved, turned
from visctrl.planning.lattice_planner import Drive, Point
from visctrl.robots.documents import StrictModel
from visctrl.robots.errors import InputError

Array = NDArray[np.float64]
NonNegative = Annotated[float, Field(ge=0.0)]

#: Share of the margin under which a way under way counts as blocked: what was planned with the
#: whole margin is not given up for a centimetre.
_TOLERATED = 0.5
#: How far to either side the robot turns to see what is not certain, and how fast (rad, rad/s):
#: each direction comes to lie at both edges of a sonar's cone, slowly enough for its cycle.
_LOOK, _LOOK_RATE = math.radians(13.0), math.radians(10.0)
_LOOKED = math.radians(1.0)
#: How far the robot backs off at a time, before it would rather turn round, and in all (m), and
#: how fast (m/s).
_BACK_M, _BACK_FIRST_M, _BACK_MOST_M, _BACK_M_S = 0.3, 0.6, 1.8, 0.1
#: Room that backing off needs behind (m), on the first leg and when turning.
_STOPPING_M = 0.35
#: A robot without a way tries again after this (s).
_AGAIN_S = 2.0


class AvoidanceOptions(StrictModel):
    """How obstacles are avoided.

    margin_m : distance of the robot's outline from an obstacle, where there is room for it.
    pause_s : how long the robot stops when something blocks its path.
    """

    margin_m: Annotated[float, Field(gt=0.0)] = 0.12
    pause_s: NonNegative = 1.0


class _State(StrEnum):
    FREE = "free"
    STOP = "stop"
    LOOK = "look"
    BACK = "back"
    BLOCKED = "blocked"


class Avoidance:
    """What a robot does about obstacles; it holds what it knows of them.

    Parameters
    ----------
    options : AvoidanceOptions
    context : Context
    """

    def __init__(self, options: AvoidanceOptions, context: Context) -> None:
        self._options = options
        self._period = context.period_s
        self._finder = WayFinder(
            Footprint.of(context.body), context.camera_forward_m, options.margin_m
        )
        self._seen: Sequence[Obstacle] = ()
        self._state = _State.FREE
        self._since = 0.0
        self._look: list[float] = []
        self._looked = False
        self._backed = 0.0
        self._back_from: Point = (0.0, 0.0)

    def expect(self, goals: Mapping[str, Point], obstacles: Sequence[Obstacle]) -> None:
        """Raise InputError where a goal, by name, leaves less than the margin.

        goals : (x, y) of the camera in the target's frame, reached with the heading 0 (m).
        """
        if not obstacles:
            return
        discs = _discs(obstacles, Pose(0.0, 0.0, 0.0))
        for name, goal in goals.items():
            gaps = self._finder.gaps(goal, discs)
            worst = int(gaps.argmin())
            if gaps[worst] < self._options.margin_m:
                x, y, _ = discs[worst].tolist()
                raise InputError(
                    f"obstacles: {name} leaves {max(float(gaps[worst]), 0.0):.2f} m to the one at "
                    f"({x:g}, {y:g}) m, and {self._options.margin_m:g} m are needed "
                    "(controller.margin_m): move one of them"
                )

    def sense(self, obstacles: Sequence[Obstacle]) -> None:
        """Keep what there is now."""
        self._seen = obstacles

    @property
    def aware(self) -> bool:
        """Whether there is anything to be done or to be minded."""
        return bool(self._seen) or not self.free

    @property
    def free(self) -> bool:
        """Whether nothing is being done about an obstacle."""
        return self._state is _State.FREE

    def may_advance(self) -> bool:
        """Return whether the robot, not knowing where it is, may go straight ahead."""
        here = Pose(0.0, 0.0, 0.0)
        way = moved(self._finder.axle(here), _STOPPING_M)
        return not self._seen or self._finder.clear(way, _discs(self._seen, here), share=_TOLERATED)

    def may_turn(self, pose: Pose, by: float) -> bool:
        """Return whether the robot may turn on the spot by an angle (rad)."""
        way = turned(self._finder.axle(pose), by)
        return not self._seen or self._finder.clear(way, _discs(self._seen, pose), share=_TOLERATED)

    def blocked(self, pose: Pose, axle: Array, last: Point | None) -> bool:
        """Return whether the way ahead is not clear; the robot then has to `halt`.

        axle : (P, 3) poses of the axle on the way, from here on.
        last : where the camera will stop for good (m), if that is where the way leads.
        """
        discs = _discs(self._seen, pose)
        return bool(self._seen) and not self._finder.clear(axle, discs, last, _TOLERATED)

    def halt(self, t: float) -> Decision:
        """Stop, at a time (s); from now on `decide` says what to do."""
        self._state, self._since = _State.STOP, t
        self._looked, self._backed = False, 0.0
        return Decision(STANDSTILL, _State.STOP.value)

    def decide(
        self, pose: Pose, goal: Point, drive: Drive, t: float, *, final: bool
    ) -> Decision | list[Point]:
        """Return what to do about what blocks the way, or the intermediate goals that lead round.

        Parameters
        ----------
        pose : Pose
            Of the camera.
        goal : (x, y)
            Where it is to go (m).
        drive : Drive
        t : float
            Time (s).
        final : bool
            Whether the robot stops there for good.
        """
        discs = _discs(self._seen, pose)
        if self._state is _State.STOP:
            if t - self._since < self._options.pause_s:
                return Decision(STANDSTILL, _State.STOP.value)
            self._begin_look(pose)
        if self._state is _State.LOOK:
            turn = self._turn(pose)
            if turn is not None:
                return turn
        if self._state is _State.BACK:
            if math.dist(self._back_from, pose[:2]) < _BACK_M and self._may_back(pose, discs):
                return Decision(Velocity(-_BACK_M_S, 0.0), _State.BACK.value)
            self._backed += _BACK_M
        if self._state is _State.BLOCKED and t - self._since < _AGAIN_S:
            return Decision(STANDSTILL, _State.BLOCKED.value)
        way: list[Point] | None = []
        if len(discs):
            retreat = self._backed >= _BACK_FIRST_M or not self._may_back(pose, discs)
            way = self._finder.way(pose, goal, discs, drive, final=final, retreat=retreat)
        if way is not None:
            self._state = _State.FREE
            return way
        return self._give_way(pose, discs, t)

    def _begin_look(self, pose: Pose) -> None:
        self._state, self._look = _State.LOOK, []
        if not self._looked and not all(obstacle.certain for obstacle in self._seen):
            self._look = [pose.phi + _LOOK, pose.phi - _LOOK]
        self._looked = True

    def _turn(self, pose: Pose) -> Decision | None:
        """Return the next step of a look to either side; None when it is over."""
        while self._look:
            left = math.remainder(self._look[0] - pose.phi, math.tau)
            if abs(left) > max(_LOOKED, 0.5 * _LOOK_RATE * self._period) and self.may_turn(
                pose, left
            ):
                return Decision(Velocity(0.0, math.copysign(_LOOK_RATE, left)), _State.LOOK.value)
            self._look.pop(0)
        return None

    def _give_way(self, pose: Pose, discs: Array, t: float) -> Decision:
        """Back off, or stand where that is not possible."""
        if self._backed < _BACK_MOST_M and self._may_back(pose, discs):
            self._state, self._back_from = _State.BACK, (pose.x, pose.y)
            return Decision(Velocity(-_BACK_M_S, 0.0), _State.BACK.value)
        self._state, self._since = _State.BLOCKED, t
        return Decision(STANDSTILL, _State.BLOCKED.value)

    def _may_back(self, pose: Pose, discs: Array) -> bool:
        way = moved(self._finder.axle(pose), -0.5 * _STOPPING_M)
        return self._finder.clear(way, discs, share=_TOLERATED)


def _discs(obstacles: Sequence[Obstacle], pose: Pose) -> Array:
    """Return obstacles as x, y, radius (M, 3) in the target's frame (m)."""
    seen = np.array([obstacle[:3] for obstacle in obstacles], dtype=np.float64).reshape(-1, 3)
    s, c = math.sin(pose.phi), math.cos(pose.phi)
    right, forward = seen[:, 0], seen[:, 1]
    x, y = pose.x + c * right - s * forward, pose.y + s * right + c * forward
    return np.stack([x, y, seen[:, 2]], axis=-1)
