"""All textures of a scene in one mipmapped image, for a renderer that filters as it draws.

Every level of the image holds the same pictures at half the size of the level before, each at
the resolution and blur that its own filter gave it, so hardware may blend between levels as it
does with any mipmap.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from itertools import islice
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.sim.render.ground import PERIOD_M, plane_levels
from visctrl.sim.render.surfaces import Rectangle, lit_planes, surfaces
from visctrl.sim.render.textures import LEVELS, Levels, Pattern
from visctrl.sim.world.scene import Ground, Scene

Image = NDArray[np.uint8]
Single = NDArray[np.float32]

#: A texel of the coarsest level covers this many of the finest, along a line.
_BLOCK = 2 ** (LEVELS - 1)
#: Sheets are about as wide as high, and at least this wide (texels).
_LEAST_WIDTH = 1024


class Picture(NamedTuple):
    """One texture, the finest level first; sides halve exactly from level to level.

    periodic : opposite edges fit together.
    """

    levels: list[Image]
    periodic: bool


class Placed(NamedTuple):
    """Where the finest level of a picture lies in the sheet (texels)."""

    column: int
    row: int
    width: int
    height: int


class TextureSheet(NamedTuple):
    """A mipmapped image of pictures.

    levels : the images. places : where each picture is.
    """

    levels: list[Image]
    places: list[Placed]


class Shown(NamedTuple):
    """What is drawn of a scene.

    rectangles : everything visible, floor and ceiling included.
    items : the scene's item that each belongs to, "" for the room.
    sheet : the textures, in the same order.
    """

    rectangles: tuple[Rectangle, ...]
    items: tuple[str, ...]
    sheet: TextureSheet


def shown(scene: Scene, planes: bool) -> Shown:
    """Return what is drawn of a scene.

    planes : floor and ceiling have textures; else each is one shade.
    """
    drawn = surfaces(scene)
    pictures = [_patterned(surface.pattern) for surface in drawn]
    rectangles = [surface.side for surface in drawn]
    items = [surface.item for surface in drawn]
    floor, overhead = lit_planes(scene)
    for which, (paint, height, ceiling) in enumerate(
        ((floor, 0.0, False), (overhead, scene.room.height_m, True))
    ):
        cells = list(_plane_cells(scene, height, ceiling))
        picture = _plane(paint, scene.seed, which, ceiling) if planes else _plain(paint)
        pictures += [picture] * len(cells)
        rectangles += cells
        items += [""] * len(cells)
    return Shown(tuple(rectangles), tuple(items), pack(pictures))


def pack(pictures: list[Picture]) -> TextureSheet:
    """Lay pictures side by side, each with a rim that interpolation may read.

    A picture that occurs several times is laid down once.
    """
    different = list({id(picture): picture for picture in pictures}.values())
    cells = [_cell(picture) for picture in different]
    widest = max(width for width, _ in cells)
    area = sum(width * height for width, height in cells)
    # Next to each other on shelves, the highest first.
    shelf = max(widest, _LEAST_WIDTH, _BLOCK * round(math.sqrt(area) / _BLOCK))
    corners: dict[int, tuple[int, int]] = {}
    column = row = high = 0
    for k in sorted(range(len(cells)), key=lambda k: cells[k][::-1], reverse=True):
        width, height = cells[k]
        if column + width > shelf:
            column, row, high = 0, row + high, 0
        corners[k] = (column, row)
        column, high = column + width, max(high, height)
    sheets = [
        np.zeros(((row + high) >> level, shelf >> level), np.uint8) for level in range(LEVELS)
    ]
    places = {}
    for k, picture in enumerate(different):
        _lay(picture, corners[k], sheets)
        height, width = picture.levels[0].shape
        column, row = corners[k]
        places[id(picture)] = Placed(column + _BLOCK, row + _BLOCK, width, height)
    return TextureSheet(sheets, [places[id(picture)] for picture in pictures])


def _cell(picture: Picture) -> tuple[int, int]:
    """Return width and height of a picture with its rim, at the finest level."""
    height, width = picture.levels[0].shape
    return width + 2 * _BLOCK, height + 2 * _BLOCK


def _lay(picture: Picture, corner: tuple[int, int], sheets: list[Image]) -> None:
    border = cv2.BORDER_WRAP if picture.periodic else cv2.BORDER_REPLICATE
    for k, (level, sheet) in enumerate(zip(picture.levels, sheets, strict=True)):
        rim = _BLOCK >> k
        whole = cv2.copyMakeBorder(level, rim, rim, rim, rim, border)
        column, row = (at >> k for at in corner)
        sheet[row : row + whole.shape[0], column : column + whole.shape[1]] = whole


@lru_cache(maxsize=1024)
def _patterned(pattern: Pattern) -> Picture:
    filtered = Levels(pattern)
    width, height = (
        _BLOCK * math.ceil(length * pattern.density / _BLOCK)
        for length in (pattern.width_m, pattern.height_m)
    )
    if pattern.kind == "plain" and pattern.margin_m == 0.0:
        width = height = _BLOCK
    sizes = [(width >> k, height >> k) for k in range(LEVELS)]
    # Filtered first: interpolation at half of the resolution or more loses nothing.
    levels = [
        _grey(np.asarray(cv2.resize(filtered.plane(k), size, interpolation=cv2.INTER_CUBIC)))
        for k, size in enumerate(sizes)
    ]
    return Picture(levels, periodic=False)


@lru_cache(maxsize=4)
def _plane(paint: Ground, seed: int, which: int, ceiling: bool) -> Picture:
    levels = [_grey(level) for level in islice(plane_levels(paint, seed, which), LEVELS)]
    # Rows run along y; the viewer above the floor has y upwards, the one below the ceiling not.
    return Picture(levels if ceiling else [level[::-1] for level in levels], periodic=True)


def _plain(paint: Ground) -> Picture:
    shade = round(255 * paint.shade)
    return Picture([np.full((_BLOCK >> k,) * 2, shade, np.uint8) for k in range(LEVELS)], True)


def _plane_cells(scene: Scene, height: float, ceiling: bool) -> Iterator[Rectangle]:
    """Yield one rectangle for each period of a plane's texture that reaches into the room."""
    room = scene.room
    first = [math.floor(low / PERIOD_M) for low, _ in (room.x_m, room.y_m)]
    last = [math.ceil(high / PERIOD_M) for _, high in (room.x_m, room.y_m)]
    right, up = np.array([PERIOD_M, 0.0, 0.0]), np.array([0.0, PERIOD_M, 0.0])
    for i in range(first[0], last[0]):
        for j in range(first[1], last[1]):
            corner = np.array([i * PERIOD_M, j * PERIOD_M, height])
            yield Rectangle(corner + up, right, -up) if ceiling else Rectangle(corner, right, up)


def _grey(plane: Single) -> Image:
    return np.asarray(np.clip(np.rint(plane), 0, 255), dtype=np.uint8)
