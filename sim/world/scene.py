"""Scenes: a room, and the panels and boxes in it, read from YAML.

Everything is given in the target's frame: x right, y forward, z up, metres. ``yaw_deg`` turns
an item counter-clockwise; at 0 its width runs along x.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from visctrl.hal.errors import InputError
from visctrl.hal.types import Pose
from visctrl.robots import Robot
from visctrl.robots.documents import StrictModel, load, validate
from visctrl.robots.unicycle import step_exact
from visctrl.sim.render.reliefs import Kind
from visctrl.sim.render.textures import BASE_DENSITY
from visctrl.sim.world.light import Light
from visctrl.sim.world.scene_files import RANDOM, check_scene_name, scene_folder

Array = NDArray[np.float64]
Positive = Annotated[float, Field(gt=0)]
#: Free on every side of an arena (m): the robot turns there.
CLEAR_M = 0.6
Shade = Annotated[float, Field(ge=0, le=1)]


class Paint(StrictModel):
    """Mean brightness and contrast, as fractions of full scale."""

    shade: Shade = 0.5
    contrast: Annotated[float, Field(ge=0, le=0.5)] = 0.35


class Ground(Paint):
    """How a floor or ceiling is painted."""

    pattern: Literal["noise", "tiles", "boards", "checker"] = "noise"


class Finish(Paint):
    """How a surface is painted (see `visctrl.sim.render.textures.Pattern`).

    look : surfaces of one look show the same, those without one each their own.
    texel_m : size of the smallest detail; coarse for what is only seen from far away.
    """

    pattern: Kind = "blobs"
    look: str = ""
    texel_m: Annotated[float, Field(ge=1 / 512, le=0.5)] = 1 / BASE_DENSITY


class Item(Finish):
    """A box that stands on the floor or hangs above it; a panel is a thin one."""

    name: Annotated[str, Field(pattern=r"^[^/]+$")]
    at_m: tuple[float, float]
    size_m: tuple[Positive, Positive, Positive]
    bottom_m: Annotated[float, Field(ge=0)] = 0.0
    yaw_deg: float = 0.0
    margin_m: Annotated[float, Field(ge=0)] = 0.03

    def outline(self) -> Array:
        """Return the corners of its footprint (4, 2), counter-clockwise (m)."""
        width, depth, _ = self.size_m
        return rectangle(Pose(*self.at_m, math.radians(self.yaw_deg)), width, depth)


class Room(StrictModel):
    """Four walls, given by the floor's extent; ``tile_m`` is the length of one textured tile."""

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    height_m: Positive
    tile_m: Positive = 2.5
    walls: Finish = Finish()
    floor: Ground = Ground(shade=0.36, contrast=0.12)
    ceiling: Ground = Ground(shade=0.7, contrast=0.12)

    @model_validator(mode="after")
    def _ordered(self) -> Room:
        if not (self.x_m[0] < self.x_m[1] and self.y_m[0] < self.y_m[1]):
            raise ValueError("x_m and y_m are [low, high] with low < high")
        return self


class _Row(StrictModel):
    count: Annotated[int, Field(ge=1, le=200)]
    step_m: tuple[float, float]


class Arena(StrictModel):
    """Where a robot is expected to drive: textures are prepared for distances from here."""

    x_m: tuple[float, float] = (-1.5, 1.5)
    y_m: tuple[float, float] = (-3.8, 0.5)


class Scene(StrictModel):
    """A room and what stands in it. ``seed`` makes all its textures.

    An item with ``count: n`` and ``step_m: [dx, dy]`` is written out as n equal ones in a row.
    """

    name: str
    title: str = ""
    seed: int = 0
    room: Room
    items: tuple[Item, ...] = ()
    arena: Arena = Arena()
    light: Light = Light()

    @model_validator(mode="before")
    @classmethod
    def _rows(cls, data: Any) -> Any:
        if not isinstance(data, dict) or not isinstance(data.get("items"), list | tuple):
            return data
        return {**data, "items": [one for item in data["items"] for one in _row(item)]}

    @model_validator(mode="after")
    def _names_differ(self) -> Scene:
        names = [item.name for item in self.items]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise ValueError(f"items need different names: {', '.join(sorted(twice))}")
        return self

    def check_clear(self, camera: Pose, camera_forward_m: float, robot: Robot, what: str) -> None:
        """Refuse a pose where the robot would touch a wall or an item.

        Parameters
        ----------
        camera : Pose
            Camera pose in the target's frame.
        camera_forward_m : float
            Camera ahead of the axle (m).
        robot : Robot
            Its outline and height count.
        what : str
            The pose's name in the message ("start", "target").

        Raises
        ------
        InputError
            The robot's outline leaves the room or overlaps an item, which is named.
        """
        outline = robot_outline(camera, camera_forward_m, robot)
        where = f"{what} ({camera.x:g}, {camera.y:g}, {math.degrees(camera.phi):g} deg)"
        (x0, x1), (y0, y1) = self.room.x_m, self.room.y_m
        low, high = outline.min(axis=0), outline.max(axis=0)
        if low[0] < x0 or high[0] > x1 or low[1] < y0 or high[1] > y1:
            raise InputError(
                f"{where}: the robot would stand in a wall of scene '{self.name}', whose floor "
                f"is x {x0:g}..{x1:g} m, y {y0:g}..{y1:g} m: choose a pose inside"
            )
        for item in self.items:
            if item.bottom_m < robot.body.height_m and overlap(outline, item.outline()):
                raise InputError(
                    f"{where}: the robot would touch '{item.name}' of scene '{self.name}' at "
                    f"({item.at_m[0]:g}, {item.at_m[1]:g}) m: choose another pose"
                )


def _row(item: Any) -> list[Any]:
    """Return what an item with a ``count`` stands for: equal items, numbered from 1."""
    if not isinstance(item, dict) or "count" not in item:
        return [item]
    row = validate({key: item.get(key) for key in ("count", "step_m")}, _Row, "a row of items")
    rest = {key: value for key, value in item.items() if key not in ("count", "step_m")}
    name, (x, y) = rest.get("name"), rest.get("at_m", (0.0, 0.0))
    (dx, dy), look = row.step_m, rest.get("look", name)
    return [
        {**rest, "name": f"{name} {k + 1}", "look": look, "at_m": (x + k * dx, y + k * dy)}
        for k in range(row.count)
    ]


def robot_outline(camera: Pose, camera_forward_m: float, robot: Robot) -> Array:
    """Return the corners (4, 2) of the robot's outline for a camera pose (m)."""
    body = robot.body
    ahead = (body.front_m - body.rear_m) / 2 - camera_forward_m
    centre = step_exact(camera, ahead, 0.0, 1.0)
    return rectangle(
        Pose(centre[0], centre[1], camera.phi), body.width_m, body.front_m + body.rear_m
    )


def keep_clear(arena: Arena) -> Array:
    """Return the corners (4, 2) of the floor that must stay free for an arena (m)."""
    (x0, x1), (y0, y1) = arena.x_m, arena.y_m
    middle = Pose((x0 + x1) / 2, (y0 + y1) / 2, 0.0)
    return rectangle(middle, x1 - x0 + 2 * CLEAR_M, y1 - y0 + 2 * CLEAR_M)


def rectangle(pose: Pose, width: float, length: float) -> Array:
    """Return the corners (4, 2) of a rectangle about ``pose``, ``length`` along its heading."""
    s, c = math.sin(pose.phi), math.cos(pose.phi)
    corners = 0.5 * np.array(
        [[width, length], [-width, length], [-width, -length], [width, -length]]
    )
    turned = corners @ np.array([[c, s], [-s, c]])
    return np.asarray(turned + np.array([pose.x, pose.y]), dtype=np.float64)


def overlap(a: Array, b: Array) -> bool:
    """Return whether two convex polygons (N, 2) overlap: no edge separates them."""
    for polygon in (a, b):
        edges = np.roll(polygon, -1, axis=0) - polygon
        normals = np.stack([edges[:, 1], -edges[:, 0]], axis=-1)
        of_a, of_b = a @ normals.T, b @ normals.T
        apart = (of_a.max(axis=0) < of_b.min(axis=0)) | (of_b.max(axis=0) < of_a.min(axis=0))
        if apart.any():
            return False
    return True


def load_scene(name: str) -> Scene:
    """Return a scene by name, from a file (``….yaml``), or made from a seed (``random:7``).

    Raises
    ------
    InputError
        No such scene (see `check_scene_name`), or its file is wrong.
    """
    check_scene_name(name)
    if name.startswith(RANDOM):
        from visctrl.sim.world.random_scene import random_scene

        return random_scene(int(name.removeprefix(RANDOM)))
    if name.endswith((".yaml", ".yml")):
        return load(Path(name), Scene)
    return load(scene_folder() / f"{name}.yaml", Scene)
