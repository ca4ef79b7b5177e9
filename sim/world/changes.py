"""What has changed in a scene since the target's image was taken there.

The image comes from the scene as it was; the robot drives in the scene as it is now.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from visctrl.sim.options import Changes
from visctrl.sim.world.scene import Item, Scene, keep_clear, overlap

Generator = np.random.Generator
Array = NDArray[np.float64]

#: Seeds of different kinds of random numbers must not meet.
_STREAM = 72
_TRIES = 40


def changed(scene: Scene, changes: Changes) -> Scene:
    """Return a scene as it is now; see `Changes`."""
    if changes == Changes():
        return scene
    rng = np.random.default_rng([changes.seed, _STREAM])
    count = len(scene.items)
    order = rng.permutation(count).tolist()
    removed = _taken(order, changes.removed, count)
    replaced = _taken(order, changes.replaced, count)
    standing = [i for i in order if scene.items[i].bottom_m == 0.0]
    moved = _taken(standing, changes.moved, count)
    items = []
    for number, item in enumerate(scene.items):
        if number in removed:
            continue
        if number in replaced:
            items.append(item.model_copy(update={"look": f"{item.look or item.name} new"}))
        elif number in moved:
            items.append(_shifted(item, _steps(changes.moved_m, rng), scene))
        elif changes.scatter_m > 0.0 and item.bottom_m == 0.0:
            items.append(_shifted(item, rng.normal(0.0, changes.scatter_m, (_TRIES, 2)), scene))
        else:
            items.append(item)
    light = scene.light if changes.light is None else changes.light
    return scene.model_copy(update={"items": tuple(items), "light": light})


def _steps(length: float, rng: Generator) -> Array:
    """Return shifts (N, 2) of one length (m) to try, one after the other."""
    angle = rng.uniform(-math.pi, math.pi, _TRIES)
    return length * np.stack([np.sin(angle), np.cos(angle)], axis=-1)


def _taken(order: list[int], share: float, count: int) -> set[int]:
    """Take a share of ``count`` from the end of a list."""
    return {order.pop() for _ in range(min(len(order), round(share * count)))}


def _shifted(item: Item, steps: Array, scene: Scene) -> Item:
    """Return an item at the first of the places tried that is free, else where it is."""
    room, clear = scene.room, keep_clear(scene.arena)
    low, high = np.array([room.x_m, room.y_m]).T
    for step in steps:
        there = item.model_copy(update={"at_m": tuple((np.array(item.at_m) + step).tolist())})
        outline = there.outline()
        inside = bool((outline > low).all() and (outline < high).all())
        if inside and not overlap(outline, clear):
            return there
    return item
