"""From a scene to textured rectangles: what a renderer draws."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from visctrl.sim.render.textures import Pattern
from visctrl.sim.world.scene import Finish, Ground, Item, Paint, Scene

Array = NDArray[np.float64]
PaintT = TypeVar("PaintT", bound=Paint)

#: Texture coordinates stay below 1, where TinyRenderer would wrap them to 0.
_LAST = 1.0 - 1e-6
#: How bright an item's sides are, painted on: light in the scene would change as items turn.
_SIDE_LIGHT = {"front": 1.0, "right": 0.8, "back": 0.95, "left": 1.15, "top": 1.3, "bottom": 0.6}
#: Keeps panels on walls off the wall's own plane.
_GROUND_CLEARANCE_M = 1e-3


@dataclass(frozen=True)
class Rectangle:
    """One visible side: ``corner`` + a ``right`` + b ``up`` (0 ≤ a, b ≤ 1), for its viewer."""

    corner: Array
    right: Array
    up: Array

    @property
    def corners(self) -> Array:
        """(4, 3): counter-clockwise for the viewer, from the lower left."""
        return self.corner + np.stack(
            [0 * self.up, self.right, self.right + self.up, self.up], axis=0
        )

    @property
    def normal(self) -> Array:
        """Unit vector (3,) towards the viewer."""
        normal = np.cross(self.right, self.up)
        return np.asarray(normal / np.linalg.norm(normal))


@dataclass(frozen=True)
class Surface:
    """A rectangle and its texture. ``item`` names the scene's item, "" for the room."""

    name: str
    pattern: Pattern
    side: Rectangle
    item: str = ""

    def obj(self, to_engine: Array) -> str:
        """Return a Wavefront mesh, its vertices turned by ``to_engine`` (3, 3)."""
        vertices = self.side.corners @ to_engine.T
        lines = ["v {:.9g} {:.9g} {:.9g}".format(*vertex) for vertex in vertices]
        corners = ((0.0, 0.0), (_LAST, 0.0), (_LAST, _LAST), (0.0, _LAST))
        lines += [f"vt {u:.7f} {v:.7f}" for u, v in corners]
        return "\n".join([*lines, "f 1/1 2/2 3/3", "f 1/1 3/3 4/4", ""])


def surfaces(scene: Scene) -> tuple[Surface, ...]:
    """Return everything that is drawn, the floor and ceiling excepted."""
    drawn: list[Surface] = []
    for item in scene.items:
        drawn += item_surfaces(item, scene)
    # What is in front comes first: a rasteriser need not shade what it hides.
    return (*drawn, *wall_surfaces(scene))


def wall_surfaces(scene: Scene) -> list[Surface]:
    """Return the room's walls, cut into tiles, seen from inside."""
    room = scene.room
    (x0, x1), (y0, y1) = room.x_m, room.y_m
    walls = {
        "front": ((x0, y1), (x1, y1)),
        "right": ((x1, y1), (x1, y0)),
        "back": ((x1, y0), (x0, y0)),
        "left": ((x0, y0), (x0, y1)),
    }
    tiles = []
    for name, (start, end) in walls.items():
        tiles += _tiles(f"{name} wall", np.array(start), np.array(end), scene)
    return tiles


def lit_planes(scene: Scene) -> tuple[Ground, Ground]:
    """Return how floor and ceiling look in the scene's light."""
    room, up = scene.room, np.array([0.0, 0.0, 1.0])
    return (
        _lit(room.floor, scene.light.gain(up, "floor")),
        _lit(room.ceiling, scene.light.gain(-up, "ceiling")),
    )


def _tiles(name: str, start: Array, end: Array, scene: Scene) -> list[Surface]:
    room = scene.room
    length = float(np.linalg.norm(end - start))
    count = max(1, round(length / room.tile_m))
    step = np.append((end - start) / count, 0.0)
    up = np.array([0.0, 0.0, room.height_m])
    sides = [Rectangle(np.append(start, 0.0) + i * step, step, up) for i in range(count)]
    walls = _lit(room.walls, scene.light.gain(sides[0].normal, name))
    looks = [room.walls.look or f"{name} {i}" for i in range(count)]
    return [
        Surface(
            f"{name} {i}",
            _pattern(walls, length / count, room.height_m, 0.0, looks[i], scene.seed),
            sides[i],
        )
        for i in range(count)
    ]


def item_surfaces(item: Item, scene: Scene) -> list[Surface]:
    """Return an item's four sides and its top, and its bottom if it hangs."""
    width, depth, height = item.size_m
    yaw = math.radians(item.yaw_deg)
    x = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    y = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    z = np.array([0.0, 0.0, 1.0])
    bottom = item.bottom_m + _GROUND_CLEARANCE_M
    centre = np.array([*item.at_m, bottom])
    around = (
        ("front", x, y, width, depth),
        ("right", y, -x, depth, width),
        ("back", -x, -y, width, depth),
        ("left", -y, x, depth, width),
    )
    drawn = []
    for side, right, inward, span, thick in around:
        corner = centre - right * span / 2 - inward * thick / 2
        rectangle = Rectangle(corner, right * span, z * height)
        drawn.append(_item_side(item, side, span, height, rectangle, scene))
    flat = centre - x * width / 2 - y * depth / 2
    top = Rectangle(flat + z * height, x * width, y * depth)
    drawn.append(_item_side(item, "top", width, depth, top, scene))
    if item.bottom_m > 0:
        under = Rectangle(flat + y * depth, x * width, -y * depth)
        drawn.append(_item_side(item, "bottom", width, depth, under, scene))
    return drawn


def _item_side(
    item: Item, side: str, width: float, height: float, rectangle: Rectangle, scene: Scene
) -> Surface:
    look = f"{item.look or item.name} {side}"
    margin = min(item.margin_m, 0.2 * min(width, height))
    shaded = item.model_copy(update={"shade": item.shade * _SIDE_LIGHT[side]})
    lit = _lit(shaded, scene.light.gain(rectangle.normal, item.name))
    pattern = _pattern(lit, width, height, margin, look, scene.seed)
    return Surface(f"{item.name} {side}", pattern, rectangle, item.name)


def _lit(paint: PaintT, gain: float) -> PaintT:
    """Return a paint as it looks where light falls on it ``gain`` times as bright as usual."""
    if gain == 1.0:
        return paint
    return paint.model_copy(update={"shade": gain * paint.shade, "contrast": gain * paint.contrast})


def _pattern(
    finish: Finish, width: float, height: float, margin: float, name: str, seed: int
) -> Pattern:
    # Too narrow for features: a texture would only flicker.
    kind = finish.pattern if min(width, height) > 0.1 else "plain"
    return Pattern(
        width, height, kind, finish.shade, finish.contrast, margin, name, seed, 1.0 / finish.texel_m
    )
