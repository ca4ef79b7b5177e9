"""The robot's outline among discs on the floor, and where it comes along a path."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.planning.paths import ParabolicPath, bend
from visctrl.robots.model import Body

Array = NDArray[np.float64]

#: The outline's border is covered by so many circles across and along.
_ACROSS, _ALONG = 4, 5
#: Samples of a path: the first steps are short, for there the robot turns most.
_CROWDED = 1.7


@dataclass(frozen=True)
class Footprint:
    """A rectangle whose border is covered by equal circles, which make it 2 or 3 cm larger.

    spots : (K, 2) middles of the circles from the axle's centre, right and forward (m).
    radius : of the circles (m).
    reach : from the axle's centre to the farthest corner (m).
    middle : of the rectangle ahead of the axle (m).
    inner, outer : from there to the nearest side and to the corners (m).
    """

    spots: Array
    radius: float
    reach: float
    middle: float
    inner: float
    outer: float

    @classmethod
    def of(cls, body: Body | None) -> Footprint:
        """Return the outline of a robot; a point on the axle for None."""
        if body is None:
            return cls(np.zeros((1, 2)), 0.0, 0.0, 0.0, 0.0, 0.0)
        right = ((np.arange(_ACROSS) + 0.5) / _ACROSS - 0.5) * body.width_m
        length = body.front_m + body.rear_m
        forward = (np.arange(_ALONG) + 0.5) / _ALONG * length - body.rear_m
        x, y = (part.ravel() for part in np.meshgrid(right, forward))
        border = (np.abs(x) > 0.999 * right[-1]) | (y == forward[0]) | (y == forward[-1])
        spots = np.stack([x, y], axis=-1)[border]
        radius = math.hypot(body.width_m / _ACROSS, length / _ALONG) / 2.0
        inner, outer = min(body.width_m, length) / 2.0, math.hypot(body.width_m, length) / 2.0
        middle = (body.front_m - body.rear_m) / 2.0
        # The circles reach a little beyond the corners.
        return cls(spots, radius, body.radius_m + radius, middle, inner, outer + radius)

    def placed(self, axle: Array) -> Array:
        """Return the circles' middles (..., K, 2) for poses (..., 3) of the axle's centre."""
        s, c = np.sin(axle[..., 2:]), np.cos(axle[..., 2:])
        right, forward = self.spots.T
        x = axle[..., :1] + c * right - s * forward
        return np.stack([x, axle[..., 1:2] + s * right + c * forward], axis=-1)

    def gaps(self, axle: Array, discs: Array) -> Array:
        """Return the distances (..., M) to discs (M, 3) for poses (..., 3) of the axle (m)."""
        spots = self.placed(axle)[..., None, :]
        away = np.hypot(spots[..., 0] - discs[:, 0], spots[..., 1] - discs[:, 1])
        return np.asarray(away.min(axis=-2) - discs[:, 2] - self.radius, dtype=np.float64)


def along(path: ParabolicPath, heading: float, lever: float, here: float, count: int) -> Array:
    """Return poses (count, 3) of the axle while the control point follows the rest of a path.

    Parameters
    ----------
    path : ParabolicPath
    heading : float
        Of the robot now (rad).
    lever : float
        Control point ahead of the axle (m).
    here : float
        The control point's height now (m): the path's rest begins there.
    count : int
    """
    low, high = sorted((path.start[1], path.goal[1]))
    first = min(max(here, low), high)
    share = np.linspace(0.0, 1.0, count) ** _CROWDED
    points = path.at_heights(first + (path.goal[1] - first) * share)
    [poses] = trailed(points[None], np.array([heading]), lever)
    return np.asarray(poses, dtype=np.float64)


def along_many(start: Array, goal: Array, straight: Array, heading: Array, lever: float) -> Array:
    """Return poses (E, P, 3) of the axle along many whole paths; all lead forward.

    Parameters
    ----------
    start, goal : (E, 2) arrays
        Where the control point begins and ends (m).
    straight : (E,) array
        Straight ends (m).
    heading : (E,) array
        Of the robot at the start (rad).
    lever : float
        Control point ahead of the axle (m).
    """
    longest = float(np.max(goal[:, 1] - start[:, 1], initial=0.0))
    share = np.linspace(0.0, 1.0, samples(longest)) ** _CROWDED
    y = start[:, 1:] + (goal[:, 1:] - start[:, 1:]) * share
    apex = goal[:, 1:] - straight[:, None]
    lateral = start[:, :1] - goal[:, :1]
    x = goal[:, :1] + lateral * bend(y, apex, start[:, 1:] - apex) ** 2
    return trailed(np.stack([x, y], axis=-1), heading, lever)


def samples(length: float) -> int:
    """Return how many samples a way of a length (m) needs."""
    return int(min(max(length / 0.15, 24.0), 160.0))


def trailed(points: Array, heading: Array, lever: float) -> Array:
    """Return poses (E, P, 3) of an axle that trails a control point along points (E, P, 2).

    Along a piece without a turn, tan(ε/2) falls as exp(−s/ℓ), ε being the path's direction less
    the heading (see `visctrl.planning.paths.path_time`).
    """
    step = np.diff(points, axis=1)
    direction = np.arctan2(-step[..., 0], step[..., 1])
    fading = np.exp(-np.hypot(step[..., 0], step[..., 1]) / lever)
    phi = np.empty(points.shape[:2])
    phi[:, 0] = heading
    for k in range(step.shape[1]):
        error = np.remainder(direction[:, k] - phi[:, k] + np.pi, 2.0 * np.pi) - np.pi
        phi[:, k + 1] = direction[:, k] - 2.0 * np.arctan(np.tan(error / 2.0) * fading[:, k])
    back = lever * np.stack([-np.sin(phi), np.cos(phi)], axis=-1)
    return np.concatenate([points - back, phi[..., None]], axis=-1)


def turned(axle: Array, by: float) -> Array:
    """Return poses (P, 3) of an axle that turns on the spot by an angle (rad)."""
    steps = 2 + int(abs(by) / math.radians(5.0))
    turning = np.repeat(axle[None], steps, axis=0)
    turning[:, 2] += np.linspace(0.0, by, steps)
    return turning


def moved(axle: Array, by: float) -> Array:
    """Return poses (P, 3) of an axle that drives straight ahead by a distance (m)."""
    way = np.linspace(0.0, by, 2 + int(abs(by) / 0.05))
    s, c = math.sin(float(axle[2])), math.cos(float(axle[2]))
    steps = np.stack([-s * way, c * way, np.zeros_like(way)], axis=-1)
    return np.asarray(axle + steps, dtype=np.float64)
