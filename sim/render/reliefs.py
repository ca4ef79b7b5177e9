"""What surfaces show before they are painted: random, regular and photographic reliefs.

Every relief is an array about 0 with values of about ±1. The regular ones repeat themselves, as
tiles, windows and shelves do: places that look alike are what a robot takes for each other.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.sim.render.photographs import photograph

Plane = NDArray[np.float32]
Generator = np.random.Generator
#: ``blobs`` polygons over noise · ``noise`` alone · ``plain`` one shade · ``checker`` black and
#: white squares · ``tiles`` equal tiles with dark joints · ``bricks`` in courses, in random shades
#: · ``boards`` equal upright boards · ``windows`` equal dark panes in a grid · ``shelves`` goods of
#: random size on shelves · ``photo`` a photograph.
Kind = Literal[
    "blobs",
    "noise",
    "plain",
    "checker",
    "tiles",
    "bricks",
    "boards",
    "windows",
    "shelves",
    "photo",
]

#: Sides of the regular patterns (m).
CHECK_M = 0.25
_TILE_M, _JOINT_M = 0.3, 0.012
_BRICK_M, _COURSE_M = 0.5, 0.2
_BOARD_M = 0.25
_WINDOW_M, _PANE = (1.5, 1.6), 0.55
_SHELF_M = 0.45
#: What a floor or ceiling may show, and after which length that repeats itself exactly (m).
PERIODS_M: dict[Kind, float] = {"tiles": _TILE_M, "boards": _BOARD_M, "checker": 2.0 * CHECK_M}

_SMALLEST_BLOB_M = 0.04
#: Area of the polygons of one size, as a rough share of the whole.
_BLOB_COVER = 0.3


def relief(kind: Kind, rng: Generator, width: int, height: int, density: float) -> Plane:
    """Return a relief (height, width).

    Parameters
    ----------
    kind : str
        See `Kind`.
    rng : numpy Generator
        Decides what is random in it.
    width, height : int
        Its size (texels).
    density : float
        Texels per metre.

    Raises
    ------
    InputError
        A photograph is asked for and there is none (see `photograph`).
    """
    return _MAKERS[kind](rng, width, height, density)


def fractal_noise(rng: Generator, width: int, height: int) -> Plane:
    """Return noise with equal variance in every octave (amplitude 1/f), of unit variance."""
    octaves = max(1, int(math.log2(max(width, height))) - 1)
    side = 2**octaves
    shape = (math.ceil(height / side) + 1, math.ceil(width / side) + 1)
    noise = rng.standard_normal(shape, dtype=np.float32)
    for _ in range(octaves):
        rows, columns = noise.shape
        finer = cv2.resize(noise, (2 * columns, 2 * rows), interpolation=cv2.INTER_CUBIC)
        noise = np.asarray(finer, np.float32)
        noise += rng.standard_normal(noise.shape, dtype=np.float32)
    noise = noise[:height, :width]
    return np.asarray(noise / noise.std(), dtype=np.float32)


def _polygons(rng: Generator, width: int, height: int, density: float) -> Plane:
    """Return random polygons of all sizes, the large ones beneath, values about ±1."""
    canvas = np.zeros((height, width), np.float32)
    radius = 0.45 * min(width, height)
    while radius > _SMALLEST_BLOB_M * density:
        count = int(_BLOB_COVER * width * height / radius**2) + 1
        corners = rng.integers(3, 7, count)
        turns = np.sort(rng.uniform(0.0, 2.0 * np.pi, (count, 6)), axis=-1)
        reach = radius * rng.uniform(0.5, 1.0, (count, 6))
        centres = rng.uniform((0.0, 0.0), (width, height), (count, 2))
        points = centres[:, None] + reach[..., None] * np.stack([np.cos(turns), np.sin(turns)], -1)
        shades = rng.uniform(-1.4, 1.4, count).tolist()
        whole = np.rint(points).astype(np.int32)
        for polygon, corner, shade in zip(whole, corners, shades, strict=True):
            cv2.fillConvexPoly(canvas, polygon[:corner], shade)
        radius /= 2.0
    return canvas


def _blobs(rng: Generator, width: int, height: int, density: float) -> Plane:
    return _polygons(rng, width, height, density) + 0.3 * fractal_noise(rng, width, height)


def _noise(rng: Generator, width: int, height: int, _density: float) -> Plane:
    return fractal_noise(rng, width, height)


def _plain(_rng: Generator, width: int, height: int, _density: float) -> Plane:
    return np.zeros((height, width), np.float32)


def _checker(_rng: Generator, width: int, height: int, density: float) -> Plane:
    across = np.floor(_metres(width, density) / CHECK_M).astype(int)
    down = np.floor(_metres(height, density) / CHECK_M).astype(int)
    return np.where((across[None, :] + down[:, None]) % 2 == 0, 3.0, -3.0).astype(np.float32)


def _tiles(_rng: Generator, width: int, height: int, density: float) -> Plane:
    joint = [
        (_metres(length, density) % _TILE_M) < max(_JOINT_M, 1.5 / density)
        for length in (height, width)
    ]
    return np.where(joint[0][:, None] | joint[1][None, :], -1.5, 0.4).astype(np.float32)


def _bricks(rng: Generator, width: int, height: int, density: float) -> Plane:
    x, y = np.meshgrid(_metres(width, density), _metres(height, density))
    course = np.floor(y / _COURSE_M).astype(int)
    along = x + 0.5 * _BRICK_M * (course % 2)
    column = np.floor(along / _BRICK_M).astype(int)
    shades = rng.normal(0.3, 0.5, (course.max() + 1, column.max() + 1))
    joint = ((along % _BRICK_M) < _JOINT_M) | ((y % _COURSE_M) < _JOINT_M)
    grain = 0.15 * fractal_noise(rng, width, height)
    return np.asarray(np.where(joint, -1.2, shades[course, column]) + grain, np.float32)


def _boards(_rng: Generator, width: int, height: int, density: float) -> Plane:
    joint = (_metres(width, density) % _BOARD_M) < max(_JOINT_M, 1.5 / density)
    return np.tile(np.where(joint, -1.5, 0.3).astype(np.float32), (height, 1))


def _windows(_rng: Generator, width: int, height: int, density: float) -> Plane:
    pane = [
        np.abs((_metres(length, density) / side) % 1.0 - 0.5) < _PANE / 2
        for length, side in ((height, _WINDOW_M[1]), (width, _WINDOW_M[0]))
    ]
    return np.where(pane[0][:, None] & pane[1][None, :], -1.5, 0.5).astype(np.float32)


def _shelves(rng: Generator, width: int, height: int, density: float) -> Plane:
    """Return rows of upright boxes of random sizes and shades, a dark board under each row."""
    canvas = np.full((height, width), -1.5, np.float32)
    row = max(4, round(_SHELF_M * density))
    for bottom in range(height, row - 1, -row):
        left = 0
        while left < width:
            wide = max(2, int(rng.uniform(0.15, 0.9) * row))
            high = max(2, int(rng.uniform(0.45, 0.9) * row))
            floor = bottom - max(1, row // 15)
            top, right = max(0, floor - high), min(width, left + wide)
            canvas[top:floor, left:right] = rng.uniform(-1.2, 1.4)
            # A label.
            label = top + high // 4
            canvas[label : label + high // 4, left + wide // 4 : right - wide // 4] = rng.uniform(
                -1.4, 1.4
            )
            left += wide + max(1, row // 30)
    return canvas


def _photo(rng: Generator, width: int, height: int, _density: float) -> Plane:
    """Return a part of a photograph at zero mean and unit deviation."""
    picture = photograph(int(rng.integers(2**31)))
    rows, columns = picture.shape
    scale = min(columns / width, rows / height)
    across, down = max(2, int(scale * width)), max(2, int(scale * height))
    left = int(rng.integers(columns - across + 1))
    top = int(rng.integers(rows - down + 1))
    part = picture[top : top + down, left : left + across].astype(np.float32)
    shrinks = scale > 1.0
    resized = cv2.resize(
        part, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    )
    centred = resized - resized.mean()
    return np.asarray(centred / max(float(centred.std()), 1.0), dtype=np.float32)


def _metres(texels: int, density: float) -> NDArray[np.float64]:
    return np.asarray((np.arange(texels) + 0.5) / density, dtype=np.float64)


_MAKERS: dict[Kind, Callable[[Generator, int, int, float], Plane]] = {
    "blobs": _blobs,
    "noise": _noise,
    "plain": _plain,
    "checker": _checker,
    "tiles": _tiles,
    "bricks": _bricks,
    "boards": _boards,
    "windows": _windows,
    "shelves": _shelves,
    "photo": _photo,
}
