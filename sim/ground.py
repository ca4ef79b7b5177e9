"""Floor and ceiling, computed per pixel instead of rasterised.

The floor is one plane through the whole picture: a software rasteriser spends half of its time
on it. Here each face pixel that looks down meets the floor at a point known up to the camera's
height, so a frame costs one turn of these points and one look-up in a filtered texture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.central_camera import CentralCamera
from hal.types import Pose
from sim.faces import Face, FaceLayout, PixelOrigin
from sim.scene import Scene
from sim.textures import BASE_DENSITY, periodic_noise

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Single = NDArray[np.float32]

#: The floor's texture repeats after this length (m).
_PERIOD_M = 6.0
_LEVELS = 8
#: Blur of a filtered level in its own texels.
_SIGMA_TEXELS = 0.7


@dataclass(frozen=True)
class _FloorPart:
    """The part of a face that may look down: its last (or first) rows.

    x, y : where its rays meet the floor one metre below, in robot axes (m).
    below : whether they meet it at all.
    """

    rows: slice
    x: Single
    y: Single
    below: NDArray[np.bool_]


class FloorTexture:
    """A periodic texture with its filtered levels side by side in one image."""

    def __init__(self, shade: float, contrast: float, seed: int) -> None:
        self._size = round(_PERIOD_M * BASE_DENSITY)
        noise = periodic_noise(np.random.default_rng([seed, 0]), self._size)
        grey = np.clip(255.0 * (shade + contrast * np.tanh(noise)), 0.0, 254.0)
        self.levels = [self._smooth(grey.astype(np.float32), _SIGMA_TEXELS)]
        while len(self.levels) < _LEVELS:
            # Variances add up to twice the blur, before every other texel is dropped.
            smooth = self._smooth(self.levels[-1], _SIGMA_TEXELS * math.sqrt(3.0))
            quarters = [smooth[i::2, j::2] for i in (0, 1) for j in (0, 1)]
            self.levels.append(np.mean(quarters, axis=0, dtype=np.float32))
        self.sheet, self.offsets = self._sheet()

    @staticmethod
    def _smooth(level: Single, sigma: float) -> Single:
        wrapped = cv2.copyMakeBorder(level, 8, 8, 8, 8, cv2.BORDER_WRAP)
        return np.asarray(cv2.GaussianBlur(wrapped, (0, 0), sigma)[8:-8, 8:-8], np.float32)

    def _sheet(self) -> tuple[Image, Single]:
        """Lay the levels side by side, each with a wrapped rim of one texel."""
        width = sum(level.shape[1] + 2 for level in self.levels)
        sheet = np.zeros((self._size + 2, width), np.uint8)
        offsets, column = [], 0
        for level in self.levels:
            rim = cv2.copyMakeBorder(level, 1, 1, 1, 1, cv2.BORDER_WRAP)
            sheet[: rim.shape[0], column : column + rim.shape[1]] = np.rint(rim)
            offsets.append(column + 1)
            column += rim.shape[1]
        return sheet, np.array(offsets, np.float32)

    def level_of(self, footprint_m: Array) -> NDArray[np.intp]:
        """Return the level whose blur fits pixels that cover ``footprint_m`` on the floor."""
        exact = np.log2(np.maximum(footprint_m * BASE_DENSITY, 1.0))
        return np.clip(np.rint(exact), 0, _LEVELS - 1).astype(np.intp)


class Backdrop:
    """What is seen where nothing has been drawn: the floor below, the ceiling above."""

    def __init__(
        self,
        scene: Scene,
        camera: CentralCamera,
        layout: FaceLayout,
        origin: PixelOrigin,
        floor: bool,
    ) -> None:
        finish = scene.room.floor
        contrast = finish.contrast if floor else 0.0
        self._texture = FloorTexture(finish.shade, contrast, scene.seed)
        self._ceiling = [
            np.full((f.height, f.width), round(255 * scene.room.ceiling_shade), np.uint8)
            for f in layout.faces
        ]
        self._parts = [_floor_part(face, camera, origin) for face in layout.faces]
        self._height_m = math.nan
        self._pose = Pose(0.0, 0.0, 0.0)
        self._scales: list[Single] = []
        self._columns: list[Single] = []

    def move(self, pose: Pose, height_m: float) -> None:
        """Take the camera's place for the next frame."""
        self._pose = pose
        if height_m != self._height_m:
            self._height_m = height_m
            self._choose_levels()

    def fill(self, index: int, picture: Image, empty: Image) -> None:
        """Paint floor and ceiling into a face's picture where the mask ``empty`` is not 0."""
        backdrop = self._ceiling[index]
        part = self._parts[index]
        if part is not None:
            looked_up = self._look_up(index, part)
            cv2.copyTo(looked_up, part.below.view(np.uint8), dst=backdrop[part.rows])
        cv2.copyTo(backdrop, empty, dst=picture)

    def _look_up(self, index: int, part: _FloorPart) -> Image:
        s = np.float32(math.sin(self._pose.phi) * self._height_m)
        c = np.float32(math.cos(self._pose.phi) * self._height_m)
        u = _fraction((c * part.x - s * part.y + np.float32(self._pose.x)) / _PERIOD_M)
        v = _fraction((s * part.x + c * part.y + np.float32(self._pose.y)) / _PERIOD_M)
        scale = self._scales[index]
        u = u * scale + self._columns[index]
        v = v * scale + np.float32(0.5)
        return np.asarray(cv2.remap(self._texture.sheet, u, v, cv2.INTER_LINEAR), np.uint8)

    def _choose_levels(self) -> None:
        self._scales, self._columns = [], []
        for part in self._parts:
            if part is None:
                self._scales.append(np.empty(0, np.float32))
                self._columns.append(np.empty(0, np.float32))
                continue
            x, y = part.x * self._height_m, part.y * self._height_m
            across = np.hypot(np.gradient(x, axis=1), np.gradient(y, axis=1))
            along = np.hypot(np.gradient(x, axis=0), np.gradient(y, axis=0))
            level = self._texture.level_of(np.where(part.below, np.sqrt(across * along), 1.0))
            sides = np.array([lv.shape[0] for lv in self._texture.levels], np.float32)
            self._scales.append(sides[level])
            # The first texel's centre is half a texel from its edge, the sheet has a rim.
            self._columns.append(self._texture.offsets[level] - np.float32(0.5))


def _fraction(value: Single) -> Single:
    return value - np.floor(value)


def _floor_part(face: Face, camera: CentralCamera, origin: PixelOrigin) -> _FloorPart | None:
    rays = face.rays(origin) @ camera.rotation.T
    below = rays[..., 2] < -1e-3
    rows = np.flatnonzero(below.any(axis=1))
    if len(rows) == 0:
        return None
    # Two rows at least: a footprint is measured between neighbours.
    first = min(int(rows[0]), face.height - 2)
    used = slice(first, max(int(rows[-1]) + 1, first + 2))
    rays, below = rays[used], np.ascontiguousarray(below[used])
    depth = np.where(below, -rays[..., 2], 1.0)
    return _FloorPart(
        used,
        (rays[..., 0] / depth).astype(np.float32),
        (rays[..., 1] / depth).astype(np.float32),
        below,
    )
