"""The canvas on which features are tracked: a cylindrical unwrap, or the image itself.

A turn of the robot rotates an omnidirectional image, and Lucas–Kanade patches, which only
translate, then drift by pixels. On a cylinder about the vertical the same turn is a shift, and
a change of distance to an upright surface a plain change of scale.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from visctrl.hal.cameras.central import CentralCamera

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float32]
Grey = NDArray[np.uint8]

#: Columns repeated beyond the seam, so that no window or pyramid level meets an edge there.
SEAM_PADDING_PX = 80
# Pixels of a small picture, about: enough to follow motion by, if not to measure it; and of a
# coarse one, which shows the turn of the robot.
_SMALL_PIXELS, _COARSE_PIXELS = 33_000, 5_000
#: Steeper features are near the robot or overhead: badly stretched, and useless for a bearing.
MAX_ELEVATION_DEG = 45.0


class Canvas(ABC):
    """An image plane with an exact map between its points and robot rays.

    Points are (column, row), the centre of the first pixel at (0, 0).

    Attributes
    ----------
    shape : (rows, columns).
    scale : pixels per radian of bearing on the horizon, straight ahead.
    field : (rows, columns) uint8, 255 where the canvas shows something.
    mask : (rows, columns) uint8, 255 where features may be: in the field, and each ray once.
    """

    shape: tuple[int, int]
    scale: float
    field: Grey
    mask: Grey

    @cached_property
    def shrink(self) -> int:
        """Side (px) of the squares of the canvas that are one pixel of its small picture."""
        return max(1, math.isqrt(self.shape[0] * self.shape[1] // _SMALL_PIXELS))

    @cached_property
    def coarseness(self) -> int:
        """Side (px) of the squares of a small picture that are one pixel of the coarse one."""
        pixels = self.shape[0] * self.shape[1] / self.shrink**2
        return max(1, round(math.sqrt(pixels / _COARSE_PIXELS)))

    @abstractmethod
    def warp(self, image: Grey) -> Grey:
        """Return the camera's image drawn on this canvas."""

    @abstractmethod
    def small(self, image: Grey) -> Grey:
        """Return the camera's image drawn on this canvas at a size less by `shrink`."""

    @cached_property
    def coarse_field(self) -> Grey:
        """The field of the coarse picture."""
        side = self.shrink * self.coarseness
        size = (self.shape[1] // side, self.shape[0] // side)
        whole = self.field[: side * size[1], : side * size[0]]
        return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_NEAREST), np.uint8)

    @cached_property
    def fading(self) -> Floats:
        """Weights of a coarse picture's pixels: none off the field, less towards either end."""
        ends = np.hanning(self.coarse_field.shape[1])
        return np.asarray(ends * (self.coarse_field > 0), dtype=np.float32)

    @abstractmethod
    def pixels(self, columns: Floats, rows: Floats) -> tuple[Floats, Floats]:
        """Return the columns and rows (N, M) in the image of canvas points or some beside it."""

    @abstractmethod
    def rays(self, points: ArrayLike) -> Array:
        """Return the unit robot rays (..., 3) of canvas points (..., 2)."""

    @abstractmethod
    def points(self, rays: ArrayLike) -> Array:
        """Return the canvas points (..., 2) of robot rays (..., 3); NaN where there is none."""

    def canonical(self, points: Array) -> Array:
        """Return the points with those that were tracked over the seam brought back."""
        return points

    def inside(self, points: ArrayLike, margin: float = 0.0) -> Mask:
        """Return whether points (..., 2) lie in the field of view and off the edges."""
        points = np.asarray(points, dtype=np.float64)
        with np.errstate(invalid="ignore"):
            kept = (points >= margin) & (points <= np.array(self.shape[::-1]) - 1.0 - margin)
        finite = np.asarray(kept.all(axis=-1))
        column, row = np.where(finite[..., None], np.rint(points), 0.0).astype(np.intp).T
        return np.asarray(finite & (self.field[row, column].T > 0))


class FlatCanvas(Canvas):
    """The camera's own image, for cameras with a plain perspective image."""

    def __init__(self, camera: CentralCamera) -> None:
        self._camera = camera
        self.shape = (camera.height, camera.width)
        self.scale = camera.pixels_per_radian
        _, seen = camera.robot_rays(_grid(self.shape))
        self.field = self.mask = np.where(seen, 255, 0).astype(np.uint8)

    def warp(self, image: Grey) -> Grey:
        """Return the image itself."""
        return image

    def small(self, image: Grey) -> Grey:
        """Return the image, smaller."""
        return shrunk(image, self.shrink)

    def pixels(self, columns: Floats, rows: Floats) -> tuple[Floats, Floats]:
        """Return the points."""
        return columns, rows

    def rays(self, points: ArrayLike) -> Array:
        """Return the unit robot rays (..., 3) of image points (..., 2)."""
        return self._camera.robot_rays(points)[0]

    def points(self, rays: ArrayLike) -> Array:
        """Return the image points (..., 2) of robot rays (..., 3); NaN where there is none."""
        return self._camera.robot_pixels(rays)[0]


class Cylinder(Canvas):
    """A cylinder about the vertical: columns are equal steps of bearing.

    Rows are equal steps of the tangent of the elevation, with the columns' scale on the horizon.
    The whole turn has a whole number of columns, so the two sides of the seam agree exactly.

    Parameters
    ----------
    camera : CentralCamera
    scale : float
        Wanted pixels per radian; it is changed a little to fit the turn.
    """

    def __init__(self, camera: CentralCamera, scale: float) -> None:
        low, high, left, right = _field_of_view(camera)
        self._full_turn = camera.panoramic
        self._padding = SEAM_PADDING_PX if self._full_turn else 0
        span = 2.0 * math.pi if self._full_turn else right - left
        columns = round(span * scale)
        self.scale = columns / span
        self._left = -math.pi if self._full_turn else left
        self._columns = columns
        self._top = math.tan(high)
        rows = math.ceil((self._top - math.tan(low)) * self.scale)
        self.shape = (rows, columns + 2 * self._padding)
        pixels, seen = camera.robot_pixels(self.rays(_grid(self.shape)))
        pixels = np.where(np.isfinite(pixels), pixels, -9.0).astype(np.float32)
        # In two parts: of a map with two channels OpenCV would round to thirty-seconds of a pixel.
        self._map = tuple(np.ascontiguousarray(pixels[..., k]) for k in (0, 1))
        # What remains to be shrunk, about twofold, interpolation averages over.
        self._before = max(1, self.shrink // 2)
        half = np.float32(0.5)
        self._small_map = tuple(
            (shrunk(m, self.shrink) + half) / np.float32(self._before) - half for m in self._map
        )
        self.field = np.where(seen, 255, 0).astype(np.uint8)
        self.mask = self.field.copy()
        if self._full_turn:
            self.mask[:, : self._padding] = 0
            self.mask[:, self._padding + columns :] = 0

    def warp(self, image: Grey) -> Grey:
        """Return the camera's image on the cylinder (one bilinear remap)."""
        x, y = self._map
        return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR), dtype=np.uint8)

    def small(self, image: Grey) -> Grey:
        """Return the camera's image on the smaller cylinder."""
        x, y = self._small_map
        return np.asarray(cv2.remap(shrunk(image, self._before), x, y, cv2.INTER_LINEAR), np.uint8)

    def pixels(self, columns: Floats, rows: Floats) -> tuple[Floats, Floats]:
        """Return where in the image canvas points lie (see `Canvas.pixels`)."""
        border = cv2.BORDER_REPLICATE
        x, y = (cv2.remap(m, columns, rows, cv2.INTER_LINEAR, borderMode=border) for m in self._map)
        return np.asarray(x, dtype=np.float32), np.asarray(y, dtype=np.float32)

    def rays(self, points: ArrayLike) -> Array:
        """Return the unit robot rays (..., 3) of canvas points (..., 2)."""
        points = np.asarray(points, dtype=np.float64)
        bearing = self._left + (points[..., 0] - self._padding + 0.5) / self.scale
        tangent = self._top - (points[..., 1] + 0.5) / self.scale
        rays = np.stack([np.sin(bearing), np.cos(bearing), tangent], axis=-1)
        return np.asarray(rays / np.hypot(1.0, tangent)[..., None], dtype=np.float64)

    def points(self, rays: ArrayLike) -> Array:
        """Return the canvas points (..., 2) of robot rays (..., 3), never in the padding."""
        rays = np.asarray(rays, dtype=np.float64)
        bearing = np.arctan2(rays[..., 0], rays[..., 1])
        tangent = rays[..., 2] / np.hypot(rays[..., 0], rays[..., 1])
        column = (bearing - self._left) * self.scale + self._padding - 0.5
        row = (self._top - tangent) * self.scale - 0.5
        return self.canonical(np.stack([column, row], axis=-1))

    def canonical(self, points: Array) -> Array:
        """Return the points with those in the padding brought back over the seam."""
        if not self._full_turn:
            return points
        points = points.copy()
        start = self._padding - 0.5
        points[..., 0] = start + np.mod(points[..., 0] - start, self._columns)
        return points


def canvas_for(camera: CentralCamera, scale: float | None = None) -> Canvas:
    """Return the canvas for a camera: its image if rectilinear and ahead, else a cylinder.

    Parameters
    ----------
    camera : CentralCamera
    scale : float, optional
        Pixels per radian of the cylinder; by default the camera's own density on the horizon.
    """
    if camera.rectilinear and not camera.panoramic:
        return FlatCanvas(camera)
    return Cylinder(camera, _horizon_density(camera) if scale is None else scale)


def _horizon_density(camera: CentralCamera) -> float:
    """Return the larger pixel density (px/rad) of the camera's image straight ahead."""
    singular = np.linalg.svd(camera.jacobian(camera.rotation.T @ [0.0, 1.0, 0.0]))[1]
    return float(singular[0])


def _field_of_view(camera: CentralCamera) -> tuple[float, float, float, float]:
    """Return the lowest and highest elevation and the least and greatest bearing seen (rad)."""
    rays, seen = camera.robot_rays(_grid((camera.height, camera.width), step=2))
    right, forward, up = rays[seen].T
    elevation = np.arctan2(up, np.hypot(right, forward))
    bound = math.radians(MAX_ELEVATION_DEG)
    low, high = max(float(elevation.min()), -bound), min(float(elevation.max()), bound)
    bearing = np.arctan2(right, forward)[np.abs(elevation) <= bound]
    return low, high, float(bearing.min()), float(bearing.max())


def shrunk(image: NDArray[Any], side: int) -> NDArray[Any]:
    """Return an image of which squares of pixels are averaged; what is left over is cut off."""
    if side == 1:
        return image
    rows, columns = (length // side for length in image.shape[:2])
    whole = image[: side * rows, : side * columns]
    return np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA))


def _grid(shape: tuple[int, int], step: int = 1) -> Array:
    """Return the pixel centres (rows, columns, 2) of an image as (column, row)."""
    row, column = np.mgrid[0 : shape[0] : step, 0 : shape[1] : step]
    return np.stack([column, row], axis=-1).astype(np.float64)
