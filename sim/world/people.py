"""People who walk to and fro beside the floor that is free to drive on.

They are seen and heard, and may be run into; furniture in their way does not stop them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from visctrl.hal.types import Pose
from visctrl.sim.world.scene import Item, Scene, keep_clear

_SIZE_M = (0.5, 0.32, 1.72)
_SPEED_M_S = 0.8
#: Beside the free floor (m), and clear of the room's walls.
_BESIDE_M, _WALL_M = 0.45, 0.35
_STREAM = 73


@dataclass(frozen=True)
class Walker:
    """A person on a straight line between two places (m), there and back.

    item : what is seen, where it is at time 0. start_s : time of the way that it begins with.
    """

    item: Item
    ends: tuple[tuple[float, float], tuple[float, float]]
    start_s: float

    def pose(self, t: float) -> Pose:
        """Return where the person is at a time (s), facing along the way."""
        (x0, y0), (x1, y1) = self.ends
        length = math.hypot(x1 - x0, y1 - y0)
        way = (_SPEED_M_S * (t + self.start_s)) % (2.0 * length)
        share = min(way, 2.0 * length - way) / length
        facing = math.atan2(-(x1 - x0), y1 - y0)
        return Pose(x0 + share * (x1 - x0), y0 + share * (y1 - y0), facing)


def people(scene: Scene, count: int, seed: int) -> tuple[Walker, ...]:
    """Return ``count`` people round the free floor of a scene, each on one side of it."""
    rng = np.random.default_rng([seed, _STREAM])
    corners = keep_clear(scene.arena)
    low, high = np.array([scene.room.x_m, scene.room.y_m]).T
    middle = corners.mean(axis=0)
    outer = corners + _BESIDE_M * np.sign(corners - middle)
    outer = np.clip(outer, low + _WALL_M, high - _WALL_M)
    walkers = []
    for number in range(count):
        a, b = outer[number % 4], outer[(number + 1) % 4]
        ends = (float(a[0]), float(a[1])), (float(b[0]), float(b[1]))
        walker = Walker(_person(number, ends[0]), ends, float(rng.uniform(0.0, 20.0)))
        at = walker.pose(0.0)
        placed = walker.item.model_copy(
            update={"at_m": (at.x, at.y), "yaw_deg": math.degrees(at.phi)}
        )
        walkers.append(Walker(placed, ends, walker.start_s))
    return tuple(walkers)


def _person(number: int, at: tuple[float, float]) -> Item:
    return Item(
        name=f"person {number + 1}",
        at_m=at,
        size_m=_SIZE_M,
        pattern="blobs",
        shade=0.3,
        contrast=0.25,
    )
