"""Search for a way round obstacles: intermediate goals, each reached by a path of its own.

Places for intermediate goals are the knots of a lattice about the robot and its goal. A path
leads from one to another where one of `visctrl.planning.paths` keeps the robot's outline clear,
and the shortest chain of paths wins. First only paths that lead forward count, which the robot
follows without turning on the spot; where that is not enough, a coarser lattice is tried on
which it may also turn round and drive the other way.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.types import Pose
from visctrl.planning.distance_field import DistanceField
from visctrl.planning.footprint import Footprint, along_many, turned
from visctrl.planning.paths import TURN_FROM, TURN_TO, reachable, straight_end
from visctrl.robots.unicycle import step_exact

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
Point = tuple[float, float]

#: Distance of the lattice's knots, across and forward, and how far it reaches (m).
_ACROSS_M, _FORWARD_M = 0.3, 0.4
_ASIDE_M, _AHEAD_M = 2.6, 5.2
#: The same for the coarse lattice, which also reaches behind the robot and beyond the goal.
_COARSE_M, _FAR_ASIDE_M, _BEHIND_M, _BEYOND_M = 0.7, 3.2, 3.0, 1.4
#: Greatest headings that may be left at the goal, where they are corrected on the spot, and at
#: intermediate goals (rad).
_SETTLED, _SETTLED_BETWEEN = math.radians(1.0), math.radians(8.0)
#: The distance field tells distances that are larger than needed by so much (m).
_BEYOND_REACH_M = 0.05
#: What a stop on the way is worth, and turning round (m).
_STOP_COSTS_M, _TURN_COSTS_M = 0.8, 1.5


class Drive(NamedTuple):
    """How paths are driven.

    lever : control point ahead of the axle (m). straight : longest straight end (m).
    """

    lever: float
    straight: float


class Search:
    """The shortest chain of clear paths over a lattice.

    Parameters
    ----------
    outline : Footprint
    camera : float
        Camera ahead of the axle (m).
    margin : float
        Distance that the outline keeps from discs (m).
    discs : (M, 3) array
        x, y, radius (m).
    drive : Drive
    """

    def __init__(
        self, outline: Footprint, camera: float, margin: float, discs: Array, drive: Drive
    ) -> None:
        self._outline = outline
        self._camera = camera
        self._margin = margin
        self._drive = drive
        self._field = DistanceField(
            discs, margin + max(outline.reach, outline.outer) + _BEYOND_REACH_M
        )

    def way(self, pose: Pose, goal: Point, *, retreat: bool) -> list[Point] | None:
        """Return the intermediate goals of the shortest chain, see `WayFinder.way`."""
        here, there = np.array([pose[:2]]), np.array([goal])
        around = self._can_turn(pose)
        if math.isfinite(self._lengths(pose, here, there, around, _SETTLED)[0]):
            return []
        found = self._forward(pose, there, around)
        if found is None and retreat:
            found = self._any_way(pose, there, around)
        return found

    def _forward(self, pose: Pose, goal: Array, around: bool) -> list[Point] | None:
        """Return a chain of paths that all lead forward."""
        knots = self._standable(_lattice(pose, goal[0]))
        last = self._lengths(_FORWARD, knots, goal, True, _SETTLED)
        first = self._lengths(pose, np.array([pose[:2]]), knots, around, _SETTLED_BETWEEN)
        if not np.isfinite(first + last).any() and np.isfinite(last).any():
            between = self._between(knots)
            first, before = _chained(first, between)
        else:
            before = np.full(len(knots), -1)
        return _traced(first + last, before, knots)

    def _any_way(self, pose: Pose, goal: Array, around: bool) -> list[Point] | None:
        """Return a chain of paths that lead forward or, turned round, back.

        Each knot counts twice: for a robot that heads forward there, and one that heads back.
        """
        knots = _coarse_lattice(pose, goal[0])
        # Where the robot can turn, and so also stand.
        axle = knots - (0.0, self._camera)
        knots = knots[self._field.at(axle) >= self._outline.reach + self._margin]
        if not len(knots):
            return None
        here, count = np.array([pose[:2]]), len(knots)
        back = Pose(0.0, 0.0, pose.phi + math.pi)
        first = np.concatenate(
            [
                self._lengths(pose, here, knots, around, _SETTLED_BETWEEN),
                self._lengths(back, -here, -knots, around, _SETTLED_BETWEEN, sense=-1.0),
            ]
        )
        between = np.full((2 * count, 2 * count), math.inf)
        between[:count, :count] = self._between(knots)
        between[count:, count:] = self._between(-knots, sense=-1.0)
        turning = np.arange(count)
        between[turning, turning + count] = between[turning + count, turning] = _TURN_COSTS_M
        last = np.full(2 * count, math.inf)
        last[:count] = self._lengths(_FORWARD, knots, goal, True, _SETTLED)
        cost, before = _chained(first, between)
        return _traced(cost + last, before, np.concatenate([knots, knots]))

    def _between(self, knots: Array, sense: float = 1.0) -> Array:
        """Return what paths between knots cost (K, K), infinite where there is none."""
        a, b = (part.ravel() for part in np.indices((len(knots), len(knots))))
        cost = np.full(len(a), math.inf)
        for part in np.array_split(np.flatnonzero(reachable(knots[a], knots[b])), 8):
            start, goal = knots[a[part]], knots[b[part]]
            cost[part] = self._lengths(_FORWARD, start, goal, True, _SETTLED_BETWEEN, sense)
        return cost.reshape(len(knots), len(knots)) + _STOP_COSTS_M

    def _lengths(
        self,
        pose: Pose,
        start: Array,
        goal: Array,
        around: bool,
        settled: float,
        sense: float = 1.0,
    ) -> Array:
        """Return the lengths (E,) of paths, infinite where they are not clear.

        Parameters
        ----------
        pose : Pose
            Its heading is that of the robot at the starts.
        start, goal : (E, 2) arrays
            Of the camera (m); either may be one for all.
        around : bool
            Whether the robot can turn on the spot at the start.
        settled : float
            Greatest heading that may be left at the goal (rad).
        sense : float
            −1 if everything is given turned by half a circle about the origin.
        """
        ahead = self._drive.lever - self._camera
        s, c = math.sin(pose.phi), math.cos(pose.phi)
        begin, end = np.broadcast_arrays(
            start + ahead * np.array([-s, c]), goal + np.array([0.0, ahead])
        )
        good = np.flatnonzero(reachable(begin, end))
        length = np.full(len(begin), math.inf)
        if not len(good):
            return length
        begin, end = begin[good], end[good]
        straight = straight_end(self._drive.straight, end[:, 1] - begin[:, 1])
        slope = 2.0 * (end[:, 0] - begin[:, 0]) / (end[:, 1] - begin[:, 1] - straight)
        error = np.remainder(-np.arctan(slope) - pose.phi + np.pi, 2.0 * np.pi) - np.pi
        left = np.where(np.abs(error) > TURN_FROM, np.copysign(TURN_TO, error), error)
        axle = along_many(begin, end, straight, pose.phi + error - left, self._drive.lever)
        clear = ((left == error) | around) & (np.abs(axle[:, -1, 2]) <= settled)
        clear[clear] = self._clear(axle[clear], sense)
        step = np.diff(axle[..., :2], axis=1)
        way = np.hypot(step[..., 0], step[..., 1]).sum(axis=1)
        length[good] = np.where(clear, way, math.inf)
        return length

    def _clear(self, axle: Array, sense: float = 1.0) -> Mask:
        """Return on which ways (E,) of the axle, poses (E, P, 3), the margin is kept."""
        outline = self._outline
        s, c = np.sin(axle[..., 2]), np.cos(axle[..., 2])
        middle = axle[..., :2] + outline.middle * np.stack([-s, c], axis=-1)
        away = self._field.at(sense * middle).min(axis=1) - self._margin
        clear = away >= outline.outer
        # Only where the middle does not tell, the whole border is looked at.
        doubtful = ~clear & (away >= outline.inner)
        border = self._field.at(sense * outline.placed(axle[doubtful])).min(axis=(1, 2))
        clear[doubtful] = border >= outline.radius + self._margin
        return np.asarray(clear, dtype=np.bool_)

    def _standable(self, knots: Array) -> Array:
        """Return the knots at which the robot can stand, heading 0."""
        axle = np.pad(knots - (0.0, self._camera), ((0, 0), (0, 1)))
        return knots[self._clear(axle[:, None])]

    def _can_turn(self, pose: Pose) -> bool:
        """Return whether the robot can turn right round where it stands."""
        axle = step_exact(pose, -self._camera, 0.0, 1.0)
        return bool(self._clear(turned(axle, 2.0 * math.pi)[None])[0])


#: What robots head at when they stand at an intermediate goal.
_FORWARD = Pose(0.0, 0.0, 0.0)


def _chained(first: Array, between: Array) -> tuple[Array, Index]:
    """Return what it costs to reach every knot (K,), and over which other one (−1: directly).

    first : (K,) by one path. between : (K, K) from each to each.
    """
    cost, before = first.copy(), np.full(len(first), -1)
    columns = np.arange(len(first))
    while True:
        through = cost[:, None] + between
        best = through.argmin(axis=0)
        cheaper = through[best, columns] < cost - 1e-9
        if not cheaper.any():
            return cost, before
        cost[cheaper] = through[best, columns][cheaper]
        before[cheaper] = best[cheaper]


def _traced(total: Array, before: Index, knots: Array) -> list[Point] | None:
    """Return the cheapest chain's knots, without those that are only turned at."""
    best = int(np.argmin(total)) if len(total) else -1
    if best < 0 or not math.isfinite(total[best]):
        return None
    chain: list[Point] = []
    while best >= 0:
        x, y = knots[best].tolist()
        if (x, y) not in chain[:1]:
            chain.insert(0, (x, y))
        best = int(before[best])
    return chain


def _lattice(pose: Pose, goal: Array) -> Array:
    """Return the places for intermediate goals (K, 2), from the robot on forward."""
    left, right = min(pose.x, goal[0]) - _ASIDE_M, max(pose.x, goal[0]) + _ASIDE_M
    # Where the goal is far away, the columns are those that a path within the depth can reach.
    left, right = max(left, pose.x - 2.0 * _AHEAD_M), min(right, pose.x + 2.0 * _AHEAD_M)
    depth = min(max(goal[1] - pose.y, 2.0 * _FORWARD_M), _AHEAD_M + _FORWARD_M)
    return _grid(
        np.arange(left, right + _ACROSS_M, _ACROSS_M),
        pose.y + np.arange(_FORWARD_M, depth, _FORWARD_M),
    )


def _coarse_lattice(pose: Pose, goal: Array) -> Array:
    """Return the places (K, 2) for intermediate goals all round."""
    left, right = min(pose.x, goal[0]) - _FAR_ASIDE_M, max(pose.x, goal[0]) + _FAR_ASIDE_M
    left, right = max(left, pose.x - 2.0 * _FAR_ASIDE_M), min(right, pose.x + 2.0 * _FAR_ASIDE_M)
    low = pose.y - _BEHIND_M
    high = min(max(pose.y, goal[1]) + _BEYOND_M, pose.y + _AHEAD_M)
    return _grid(np.arange(left, right, _COARSE_M), np.arange(low, high, _COARSE_M))


def _grid(x: Array, y: Array) -> Array:
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
