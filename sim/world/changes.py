"""What has changed in a scene since the target's image was taken there.

The image comes from the scene as it was; the robot drives in the scene as it is now.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from pydantic import Field

from visctrl.robots.documents import StrictModel
from visctrl.sim.world.light import Light
from visctrl.sim.world.scene import Item, Scene, keep_clear, overlap

Generator = np.random.Generator
Share = Annotated[float, Field(ge=0.0, le=1.0)]

#: Seeds of different kinds of random numbers must not meet.
_STREAM = 72
_TRIES = 40


class Changes(StrictModel):
    """How a scene differs from what it was when the target's image was taken.

    removed, replaced, moved : shares of the things, drawn in this order; no thing is drawn twice.
        What is replaced looks other at the same place. What is moved stands on the floor and
        ends ``moved_m`` away, never on the floor that is free to drive on.
    scatter_m : standard deviation of a shift, in x and in y, of every other thing on the floor.
    light : in place of the scene's.
    gain, gamma : of the camera's exposure: a share s of full scale is now shown as (gain s)^gamma.
    seed : of all that is drawn.
    """

    removed: Share = 0.0
    replaced: Share = 0.0
    moved: Share = 0.0
    moved_m: Annotated[float, Field(gt=0.0, le=5.0)] = 0.5
    scatter_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    light: Light | None = None
    gain: Annotated[float, Field(gt=0.0, le=5.0)] = 1.0
    gamma: Annotated[float, Field(gt=0.0, le=5.0)] = 1.0
    seed: Annotated[int, Field(ge=0)] = 0

    def now(self, scene: Scene) -> Scene:
        """Return the scene as it is now."""
        if self == Changes():
            return scene
        rng = np.random.default_rng([self.seed, _STREAM])
        order = rng.permutation(len(scene.items)).tolist()
        removed = _taken(order, self.removed, len(scene.items))
        replaced = _taken(order, self.replaced, len(scene.items))
        standing = [i for i in order if scene.items[i].bottom_m == 0.0]
        moved = _taken(standing, self.moved, len(scene.items))
        items = []
        for number, item in enumerate(scene.items):
            if number in removed:
                continue
            if number in replaced:
                items.append(item.model_copy(update={"look": f"{item.look or item.name} new"}))
            elif number in moved:
                items.append(_shifted(item, self._step(rng), scene))
            elif self.scatter_m > 0.0 and item.bottom_m == 0.0:
                step = rng.normal(0.0, self.scatter_m, (_TRIES, 2))
                items.append(_shifted(item, step, scene))
            else:
                items.append(item)
        light = scene.light if self.light is None else self.light
        return scene.model_copy(update={"items": tuple(items), "light": light})

    def _step(self, rng: Generator) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        """Return shifts (N, 2) to try, one after the other (m)."""
        angle = rng.uniform(-math.pi, math.pi, _TRIES)
        return self.moved_m * np.stack([np.sin(angle), np.cos(angle)], axis=-1)


def _taken(order: list[int], share: float, count: int) -> set[int]:
    """Take a share of ``count`` from the end of a list."""
    return {order.pop() for _ in range(min(len(order), round(share * count)))}


def _shifted(
    item: Item, steps: np.ndarray[tuple[int, ...], np.dtype[np.float64]], scene: Scene
) -> Item:
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
