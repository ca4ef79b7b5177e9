"""Reference paths in the target's frame: parabolas that end along the y axis, and their timing.

A stage leads the control point from (xi, yi) to (xf, yf) by (4.25),

    yd = (yi − yf)/2 (1 + cos(π t/τ)) + yf,        xd = (xi − xf) ((yd − ya)/(yi − ya))² + xf,

which starts and ends at rest with the heading 0 at the end. In the source ya = yf. Here the
apex ya may lie before the goal, and the rest of the way is straight: a robot whose control
point is at the distance ℓ ahead of the axle forgets its heading error along the way as
exp(−s/ℓ), and what a curve leaves of it needs some straight way to die out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from visctrl.robots import Limits

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Farther from the path's direction than this (rad), the robot turns on the spot first.
TURN_FROM, TURN_TO = math.radians(100.0), math.radians(20.0)

#: Largest share of a path's height that its straight end takes.
STRAIGHT_SHARE = 0.4
#: Samples of a path, and of its timing.
_SAMPLES = 400


class Reference(NamedTuple):
    """Where the control point should be, and how it should move there.

    position : x, y (m).
    velocity : their derivatives (m/s).
    """

    position: tuple[float, float]
    velocity: tuple[float, float]


@dataclass(frozen=True)
class ParabolicPath:
    """A parabola and a straight end from one point to another.

    start, goal : (x, y) in metres.
    straight : length of the end (m), at most the whole way in y.
    """

    start: tuple[float, float]
    goal: tuple[float, float]
    straight: float = 0.0

    def at(self, t: float, tau: float) -> Reference:
        """Return the reference at ``t`` of ``tau`` seconds; at rest before 0 and after ``tau``."""
        t = min(max(t, 0.0), tau)
        height = self.start[1] - self.goal[1]
        y = self.goal[1] + height / 2.0 * (1.0 + math.cos(math.pi * t / tau))
        y_rate = -height * math.pi / (2.0 * tau) * math.sin(math.pi * t / tau)
        x, slope = self._lateral(y)
        return Reference((x, y), (slope * y_rate, y_rate))

    def points(self, count: int = _SAMPLES) -> Array:
        """Return points (count, 2) of the path, dense towards its ends as its timing is."""
        way = (1.0 + np.cos(np.linspace(0.0, np.pi, count))) / 2.0
        return self.at_heights(self.goal[1] + (self.start[1] - self.goal[1]) * way)

    def at_heights(self, y: Array) -> Array:
        """Return the points (K, 2) of the path at some heights (K,)."""
        apex, span = map(np.asarray, self._bend)
        lateral = self.start[0] - self.goal[0]
        return np.stack([self.goal[0] + lateral * bend(y, apex, span) ** 2, y], axis=-1)

    @property
    def length(self) -> float:
        """Length of the path (m)."""
        return float(np.linalg.norm(np.diff(self.points(), axis=0), axis=1).sum())

    @property
    def heading(self) -> float:
        """Heading along the path at its start (rad)."""
        forth = math.copysign(1.0, self.goal[1] - self.start[1])
        return math.atan2(-self._lateral(self.start[1])[1] * forth, forth)

    def _lateral(self, y: float) -> tuple[float, float]:
        """Return x and dx/dy at a height."""
        apex, span = self._bend
        lateral = self.start[0] - self.goal[0]
        ratio = bend(y, apex, span)
        return self.goal[0] + lateral * ratio**2, 2.0 * lateral * ratio / span

    @cached_property
    def _bend(self) -> tuple[float, float]:
        """Height of the apex, and the start's above it (m)."""
        up = math.copysign(1.0, self.goal[1] - self.start[1])
        apex = self.goal[1] - up * self.straight
        return apex, (self.start[1] - apex) or -up * 1e-9


Height = TypeVar("Height", float, Array)


def bend(y: Height, apex: Height, span: Height) -> Height:
    """Return how far along the bent part of a path a height is: 1 at its start, 0 from the apex on.

    y, apex, span : heights (m), all floats or all arrays; ``span`` is the start's above the apex.
    """
    ratio = (y - apex) / span
    return ratio * (ratio > 0.0)


def path_between(
    start: tuple[float, float], goal: tuple[float, float], straight: float
) -> ParabolicPath:
    """Return the path to a goal with a straight end of ``straight`` m, less on a short way."""
    return ParabolicPath(start, goal, float(straight_end(straight, goal[1] - start[1])))


def straight_end(straight: float, ahead: ArrayLike) -> Array:
    """Return the straight ends (m) of paths that lead so far ahead (m)."""
    return np.minimum(straight, STRAIGHT_SHARE * np.abs(ahead))


def path_time(
    path: ParabolicPath, heading: float, lever: float, limits: Limits | None, reserve: float
) -> float:
    """Return the shortest time (s) in which a robot follows a path from its present heading.

    With the control point on the path, v = |xd'| cos ε and ω = |xd'| sin ε / ℓ, ε being the
    path's direction less the heading; along a piece of the way without a turn tan(ε/2) falls as
    exp(−s/ℓ), which is exact and needs no small steps. Speeds, those of the wheels too, fall as
    1/τ and accelerations as 1/τ².

    Parameters
    ----------
    path : ParabolicPath
    heading : float
        Of the robot at the path's start (rad).
    lever : float
        Control point ahead of the axle, ℓ (m).
    limits : Limits or None
        What the robot can do; None for any.
    reserve : float
        Share of each limit that the path may ask for.
    """
    if limits is None:
        return 0.0
    step = np.diff(path.points(), axis=0)
    length = np.maximum(np.linalg.norm(step, axis=1), 1e-12)
    direction = np.arctan2(-step[:, 0], step[:, 1])
    error = np.empty(len(length))
    phi = heading
    for k, (ahead, way) in enumerate(zip(direction.tolist(), length.tolist(), strict=True)):
        before = math.remainder(ahead - phi, math.tau)
        after = 2.0 * math.atan(math.tan(before / 2.0) * math.exp(-way / lever))
        error[k] = 0.5 * (before + after)
        phi = ahead - after
    # Velocities, and their changes, if it took one second.
    speed = length * len(length)
    v, omega = speed * np.cos(error), speed * np.sin(error) / lever
    v_change, omega_change = (
        np.abs(np.diff(part, prepend=0.0, append=0.0)).max() * len(length) for part in (v, omega)
    )
    fastest = max(map(limits.ratio, v.tolist(), omega.tolist()))
    return max(
        fastest / reserve,
        math.sqrt(v_change / (reserve * limits.acceleration_m_s2)),
        math.sqrt(omega_change / (reserve * limits.angular_acceleration_rad_s2)),
    )


def reachable(start: ArrayLike, goal: ArrayLike) -> Mask:
    """Return whether parabolas lead from points (..., 2) to goals without a violent start."""
    way = np.asarray(goal, dtype=np.float64) - np.asarray(start, dtype=np.float64)
    return (way[..., 1] > 0.0) & (way[..., 1] >= 0.5 * np.abs(way[..., 0]))


def detour(start: tuple[float, float], goal: tuple[float, float]) -> tuple[float, float]:
    """Return an intermediate goal, straight behind the start, from which the goal is reachable."""
    return start[0], goal[1] - max(1.0, abs(start[0] - goal[0]))
