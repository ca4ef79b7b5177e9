"""Floor and ceiling, computed per pixel instead of rasterised.

They are planes through the whole picture, and a software rasteriser spends half of its time on
one of them. Here each face pixel that looks down or up meets its plane at a point known up to
the camera's height, so a frame costs one turn of these points and one look-up in a filtered
texture.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Pose
from visctrl.sim.render.reliefs import PERIODS_M, relief
from visctrl.sim.render.surfaces import lit_planes
from visctrl.sim.render.textures import periodic_noise
from visctrl.sim.render.view_atlas import FaceLayout, PixelOrigin
from visctrl.sim.world.scene import Ground, Scene

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Single = NDArray[np.float32]

#: A plane's texture repeats after this length (m): longer than what is seen of it at a time.
PERIOD_M = 16.0
_SIDE_TEXELS = 2048
_LEVELS = 8
#: Blur of a filtered level in its own texels.
_SIGMA_TEXELS = 0.7
#: Rays this near to the horizon meet no plane.
_LEVEL_RAY = 1e-3


class PlaneTexture:
    """A periodic texture with its filtered levels side by side in one image.

    sheet : the image.
    sides : side of each level (texels).
    columns : where each begins in the sheet, in the coordinates of `cv2.remap`.
    """

    def __init__(self, paint: Ground, seed: int, which: int) -> None:
        levels = list(islice(plane_levels(paint, seed, which), _LEVELS))
        self.sides = np.array([level.shape[0] for level in levels], np.float32)
        self.sheet, self.columns = _sheet(levels)

    def level_of(self, footprint_m: Array) -> NDArray[np.intp]:
        """Return the level whose blur fits pixels that cover ``footprint_m`` on the plane."""
        exact = np.log2(np.maximum(footprint_m * _SIDE_TEXELS / PERIOD_M, 1.0))
        return np.clip(np.rint(exact), 0, _LEVELS - 1).astype(np.intp)


def plane_levels(paint: Ground, seed: int, which: int) -> Iterator[Single]:
    """Yield a periodic texture of side `PERIOD_M` in grey levels, each half as fine as the last.

    Each is blurred as its resolution needs; the first has 128 texels a metre.
    """
    rng = np.random.default_rng([seed, which])
    if paint.pattern == "noise":
        height_map = periodic_noise(rng, _SIDE_TEXELS)
    else:
        # A whole number of the pattern's own periods, so that opposite edges fit.
        period = PERIODS_M[paint.pattern]
        density = _SIDE_TEXELS / (period * round(PERIOD_M / period))
        height_map = relief(paint.pattern, rng, _SIDE_TEXELS, _SIDE_TEXELS, density)
    grey = np.clip(255.0 * (paint.shade + paint.contrast * np.tanh(height_map)), 0.0, 255.0)
    level = _smooth(grey.astype(np.float32), _SIGMA_TEXELS)
    while True:
        yield level
        # Variances add up to twice the blur, before every other texel is dropped.
        smooth = _smooth(level, _SIGMA_TEXELS * math.sqrt(3.0))
        quarters = [smooth[i::2, j::2] for i in (0, 1) for j in (0, 1)]
        level = np.mean(quarters, axis=0, dtype=np.float32)


@lru_cache(maxsize=8)
def plane_texture(paint: Ground, seed: int, which: int) -> PlaneTexture:
    """Return a texture, the same one for the same arguments: it takes a while to make."""
    return PlaneTexture(paint, seed, which)


@dataclass(frozen=True)
class _Part:
    """The rows of a face that may look at a plane.

    x, y : where its rays meet the plane at unit distance, in robot axes.
    seen : whether they meet it at all.
    """

    rows: slice
    x: Single
    y: Single
    seen: Mask


class _Plane:
    """One plane as the faces see it: ``sign`` −1 is the floor, +1 the ceiling."""

    def __init__(self, texture: PlaneTexture, rays: list[Array], sign: int) -> None:
        self._texture = texture
        self._parts = [_part(directions, sign) for directions in rays]
        self._distance = math.nan
        self._scales: list[Single] = []
        self._columns: list[Single] = []

    def paint(self, index: int, picture: Image, pose: Pose, distance: float) -> None:
        """Draw the plane into a face's picture; it lies ``distance`` (m) from the camera."""
        part = self._parts[index]
        if part is None:
            return
        if distance != self._distance:
            self._choose_levels(distance)
        s = np.float32(math.sin(pose.phi) * distance)
        c = np.float32(math.cos(pose.phi) * distance)
        u = _fraction((c * part.x - s * part.y + np.float32(pose.x)) / PERIOD_M)
        v = _fraction((s * part.x + c * part.y + np.float32(pose.y)) / PERIOD_M)
        u = u * self._scales[index] + self._columns[index]
        # The sheet's rim is one texel, the first texel's centre half a texel from its edge.
        v = v * self._scales[index] + np.float32(0.5)
        looked_up = cv2.remap(self._texture.sheet, u, v, cv2.INTER_LINEAR)
        cv2.copyTo(looked_up, part.seen.view(np.uint8), dst=picture[part.rows])

    def _choose_levels(self, distance: float) -> None:
        self._distance = distance
        self._scales, self._columns = [], []
        for part in self._parts:
            level = np.empty((0, 0), np.intp)
            if part is not None:
                footprint = distance * np.sqrt(_spacing(part, 0) * _spacing(part, 1))
                level = self._texture.level_of(np.where(part.seen, footprint, 1.0))
            self._scales.append(self._texture.sides[level])
            self._columns.append(self._texture.columns[level])


class Backdrop:
    """What is seen where nothing has been drawn: the floor below, the ceiling above.

    Parameters
    ----------
    scene : Scene
        Height and paint of the room.
    camera : CentralCamera
        Orientation of the faces on the robot.
    layout : FaceLayout
        The faces.
    origin : PixelOrigin
        Where their pixels sample.
    textured : bool
        Paint with texture, or in one shade each.
    """

    def __init__(
        self,
        scene: Scene,
        camera: CentralCamera,
        layout: FaceLayout,
        origin: PixelOrigin,
        textured: bool,
    ) -> None:
        floor_paint, ceiling_paint = lit_planes(scene)
        rays = [face.rays(origin) @ camera.rotation.T for face in layout.faces]
        self._plain = [
            _two_shades(r, 255 * floor_paint.shade, 255 * ceiling_paint.shade) for r in rays
        ]
        self._ceiling_m = scene.room.height_m
        self._planes: list[_Plane] = []
        if textured:
            floor = plane_texture(floor_paint, scene.seed, 0)
            ceiling = plane_texture(ceiling_paint, scene.seed, 1)
            self._planes = [_Plane(floor, rays, -1), _Plane(ceiling, rays, 1)]

    def fill(self, index: int, picture: Image, empty: Mask, pose: Pose, height_m: float) -> None:
        """Paint floor and ceiling into a face's picture where it is ``empty``."""
        backdrop = self._plain[index]
        distances = (height_m, self._ceiling_m - height_m)
        for plane, distance in zip(self._planes, distances, strict=False):
            plane.paint(index, backdrop, pose, distance)
        cv2.copyTo(backdrop, empty.view(np.uint8), dst=picture)


def _sheet(levels: list[Single]) -> tuple[Image, Single]:
    """Lay levels side by side, each with a wrapped rim of one texel."""
    width = sum(level.shape[1] + 2 for level in levels)
    sheet = np.zeros((levels[0].shape[0] + 2, width), np.uint8)
    columns, start = [], 0
    for level in levels:
        rim = cv2.copyMakeBorder(level, 1, 1, 1, 1, cv2.BORDER_WRAP)
        sheet[: rim.shape[0], start : start + rim.shape[1]] = np.rint(rim)
        columns.append(start + 0.5)
        start += rim.shape[1]
    return sheet, np.array(columns, np.float32)


def _smooth(level: Single, sigma: float) -> Single:
    wrapped = cv2.copyMakeBorder(level, 8, 8, 8, 8, cv2.BORDER_WRAP)
    return np.asarray(cv2.GaussianBlur(wrapped, (0, 0), sigma)[8:-8, 8:-8], np.float32)


def _fraction(value: Single) -> Single:
    return value - np.floor(value)


def _spacing(part: _Part, axis: int) -> Array:
    """Return how far apart neighbouring pixels meet the plane at unit distance."""
    return np.hypot(np.gradient(part.x, axis=axis), np.gradient(part.y, axis=axis))


def _two_shades(rays: Array, below: float, above: float) -> Image:
    return np.where(rays[..., 2] < 0.0, round(below), round(above)).astype(np.uint8)


def _part(rays: Array, sign: int) -> _Part | None:
    """Return the part of a face with ``rays`` (H, W, 3) that may look at a plane."""
    seen = sign * rays[..., 2] > _LEVEL_RAY
    rows = np.flatnonzero(seen.any(axis=1))
    if len(rows) == 0:
        return None
    # Two rows at least: a footprint is measured between neighbours.
    first = min(int(rows[0]), len(rays) - 2)
    used = slice(first, max(int(rows[-1]) + 1, first + 2))
    rays, seen = rays[used], np.ascontiguousarray(seen[used])
    depth = np.where(seen, np.abs(rays[..., 2]), 1.0)
    return _Part(
        used,
        (rays[..., 0] / depth).astype(np.float32),
        (rays[..., 1] / depth).astype(np.float32),
        seen,
    )
