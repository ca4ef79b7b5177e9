"""Scenes drawn at random: rooms of every size, finish and furnishing, from a seed.

They serve to try what was not made for them. The floor on which the robot drives stays free;
all else is drawn: the room, how its walls, floor and ceiling are painted, the light, how much
stands there, how high, how large and how it looks, and whether some of it is alike.
"""

from __future__ import annotations

import numpy as np

from visctrl.sim.render.reliefs import Kind
from visctrl.sim.world.light import Light
from visctrl.sim.world.scene import (
    CLEAR_M,
    Arena,
    Finish,
    Ground,
    Item,
    Room,
    Scene,
    keep_clear,
    overlap,
)

Generator = np.random.Generator

#: Seeds of different kinds of random numbers must not meet.
_STREAM = 71
_WALLS: tuple[Kind, ...] = ("blobs", "noise", "noise", "bricks", "boards", "plain")
_THINGS: tuple[Kind, ...] = ("blobs", "blobs", "noise", "boards", "shelves", "bricks")
_TRIES = 30


def random_scene(seed: int) -> Scene:
    """Return the scene of a seed."""
    rng = np.random.default_rng([seed, _STREAM])
    arena = Arena()
    room = _room(rng, arena)
    items: list[Item] = []
    for number in range(int(rng.integers(6, 26))):
        item = _item(rng, f"thing {number}", room, arena, items)
        if item is not None:
            items.append(item)
    items += [_poster(rng, f"poster {n}", room) for n in range(int(rng.integers(2, 7)))]
    if rng.random() < 0.3:
        items += _likes(rng, room, arena)
    light = Light(
        brightness=float(rng.uniform(0.6, 1.25)),
        side=float(rng.choice([0.0, rng.uniform(0.1, 0.5)])),
        from_deg=float(rng.uniform(-180.0, 180.0)),
    )
    title = f"Random room {seed}"
    return Scene(
        name=f"random {seed}", title=title, seed=seed, room=room, items=tuple(items), light=light
    )


def _room(rng: Generator, arena: Arena) -> Room:
    """Return a room around the arena, 1.2 to 9 m away on every side."""
    left, right, back, front = np.exp(rng.uniform(np.log(1.2), np.log(9.0), 4)).tolist()
    return Room(
        x_m=(arena.x_m[0] - left, arena.x_m[1] + right),
        y_m=(arena.y_m[0] - back, arena.y_m[1] + 1.5 + front),
        height_m=float(rng.uniform(2.3, 4.5)),
        walls=Finish(
            pattern=_one(rng, _WALLS),
            shade=float(rng.uniform(0.3, 0.7)),
            contrast=float(rng.uniform(0.03, 0.3)),
        ),
        floor=Ground(
            pattern="noise" if rng.random() < 0.7 else "tiles",
            shade=float(rng.uniform(0.25, 0.5)),
            contrast=float(rng.uniform(0.02, 0.2)),
        ),
        ceiling=Ground(shade=float(rng.uniform(0.5, 0.85)), contrast=float(rng.uniform(0.0, 0.15))),
    )


def _item(rng: Generator, name: str, room: Room, arena: Arena, others: list[Item]) -> Item | None:
    """Return a thing that stands free of the arena and of others, None if there is no room."""
    for _ in range(_TRIES):
        width, depth = np.exp(rng.uniform(np.log(0.2), np.log(2.0), 2)).tolist()
        item = Item(
            name=name,
            at_m=(float(rng.uniform(*room.x_m)), float(rng.uniform(*room.y_m))),
            size_m=(width, depth, float(rng.uniform(0.3, min(2.2, room.height_m)))),
            yaw_deg=float(rng.uniform(0.0, 180.0)),
            pattern=_one(rng, _THINGS),
            shade=float(rng.uniform(0.2, 0.75)),
            contrast=float(rng.uniform(0.1, 0.4)),
        )
        outline = item.outline()
        inside = (outline > [room.x_m[0], room.y_m[0]]) & (outline < [room.x_m[1], room.y_m[1]])
        if not inside.all() or overlap(outline, keep_clear(arena)):
            continue
        if not any(overlap(outline, other.outline()) for other in others):
            return item
    return None


def _poster(rng: Generator, name: str, room: Room) -> Item:
    """Return a flat picture on one of the walls."""
    wide, high = rng.uniform(0.5, 1.8), rng.uniform(0.5, 1.4)
    side = int(rng.integers(4))
    low, length = (room.x_m, room.y_m)[side % 2]
    along = float(rng.uniform(low + wide / 2, max(length - wide / 2, low + wide / 2 + 0.01)))
    wall = (room.y_m, room.x_m)[side % 2][side // 2]
    wall += 0.03 if side // 2 == 0 else -0.03
    at, size = ((along, wall), (wide, 0.04)) if side % 2 == 0 else ((wall, along), (0.04, wide))
    return Item(
        name=name,
        at_m=(float(at[0]), float(at[1])),
        size_m=(float(size[0]), float(size[1]), float(high)),
        bottom_m=float(rng.uniform(0.4, max(0.5, room.height_m - high - 0.1))),
        pattern=_one(rng, ("blobs", "noise")),
        shade=float(rng.uniform(0.35, 0.65)),
    )


def _likes(rng: Generator, room: Room, arena: Arena) -> list[Item]:
    """Return three to six equal things in a row along the arena, where they are in the room."""
    x = arena.x_m[1] + CLEAR_M + 0.5
    x = x if rng.random() < 0.5 else -x
    step, size = float(rng.uniform(0.8, 1.6)), float(rng.uniform(0.3, 0.5))
    high, pattern = float(rng.uniform(0.6, 2.0)), _one(rng, _THINGS)
    row = [
        Item(
            name=f"like {number}",
            at_m=(x, -3.0 + step * number),
            size_m=(size, size, high),
            pattern=pattern,
            look="like",
        )
        for number in range(int(rng.integers(3, 7)))
    ]
    return [
        item
        for item in row
        if room.x_m[0] + size < item.at_m[0] < room.x_m[1] - size
        and room.y_m[0] + size < item.at_m[1] < room.y_m[1] - size
    ]


def _one(rng: Generator, kinds: tuple[Kind, ...]) -> Kind:
    return kinds[int(rng.integers(len(kinds)))]
