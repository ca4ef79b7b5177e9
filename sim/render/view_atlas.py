"""How a central camera's image is put together from a few perspective views.

A rasteriser draws planes, not mirrors. The rays of the image are divided among *faces*: views
with tight off-axis frusta, each just fine enough for its share of the image. Drawn side by side
in an atlas, one interpolation makes the image of them.

Face axes are those of OpenGL's eye: x right, y up, z towards the viewer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Rim of each face, so that interpolation at its border stays on the face (px).
_RIM = 1
#: Every how many pixels the image is looked at while layouts are compared.
_STRIDE = 4
#: Share of a face's pixels that are drawn at least as finely as the image needs.
_QUANTILE = 0.5
#: Up to this angle from the axis one flat view does.
_SINGLE_POLAR_DEG = 50.0
#: With the axis' surroundings hidden this far, views are laid out as rings.
_RING_POLAR_DEG = 20.0
_RING_SECTORS = (6, 8, 10)
_RING_TILTS_DEG = tuple(range(40, 125, 5))
_RING_SPLITS_DEG = (85, 90, 95, 100, 105)


class PixelOrigin(NamedTuple):
    """Where a rasteriser's first pixel samples, from the upper left corner of its window (px)."""

    column: float
    row: float


@dataclass(frozen=True)
class Face:
    """One perspective view.

    rotation : (3, 3), columns are the eye's axes in camera axes.
    left, right, bottom, top : the frustum at unit distance (tangents).
    width, height : its size (px).
    row : where it starts in the atlas.
    """

    rotation: Array
    left: float
    right: float
    bottom: float
    top: float
    width: int
    height: int
    row: int

    def rays(self, origin: PixelOrigin) -> Array:
        """Return the directions (height, width, 3) of its pixels in camera axes (not unit)."""
        x = self.left + (np.arange(self.width) + origin.column) * (
            (self.right - self.left) / self.width
        )
        y = self.top - (np.arange(self.height) + origin.row) * (
            (self.top - self.bottom) / self.height
        )
        eye = np.stack(np.broadcast_arrays(x[None, :], y[:, None], -1.0), axis=-1)
        return eye @ self.rotation.T


@dataclass(frozen=True)
class FaceLayout:
    """The faces of a camera and the map from their atlas to its image.

    size : (height, width) of the atlas (px).
    map_xy, map_fraction : fixed-point maps of `cv2.remap`, as large as the camera's image.
    outside : True where the image shows nothing (beyond the mirror or lens).
    """

    faces: tuple[Face, ...]
    size: tuple[int, int]
    map_xy: NDArray[np.int16]
    map_fraction: NDArray[np.uint16]
    outside: Mask

    @property
    def pixels(self) -> int:
        """Number of pixels to draw."""
        return sum(face.width * face.height for face in self.faces)

    def compose(self, atlas: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the camera's image (H, W) of an atlas; zero where it shows nothing."""
        image = cv2.remap(
            atlas,
            self.map_xy,
            self.map_fraction,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=0,
        )
        return np.asarray(image, dtype=np.uint8)


class _Views(NamedTuple):
    """Directions of view, and which of them draws which ray of the image.

    rotations : one (3, 3) per view, columns are the eye's axes in camera axes.
    owner : (...) index of the view of each pixel; −1 where the image shows nothing.
    """

    rotations: list[Array]
    owner: NDArray[np.intp]


def plan_faces(camera: CentralCamera, origin: PixelOrigin, detail: float = 1.0) -> FaceLayout:
    """Choose the faces for a camera.

    Parameters
    ----------
    camera : CentralCamera
        The camera whose image is wanted.
    origin : PixelOrigin
        Pixel convention of the renderer that draws the faces.
    detail : float
        Face pixels per image pixel along a line, at the median of each face.
    """
    pixels, rays, valid = _grid(camera, 1)
    views = _choose_views(camera, rays, valid)
    faces: list[Face] = []
    maps = np.full((*valid.shape, 2), -10.0, dtype=np.float32)
    row = 0
    for i, rotation in enumerate(views.rotations):
        mine = views.owner == i
        if not mine.any():
            continue
        face = _fit(camera, rotation, pixels[mine], origin, detail, row)
        at = _columns_rows(_plane(rays[mine], rotation), face, origin)
        maps[mine] = at + np.array([0.0, row], np.float32)
        faces.append(face)
        row += face.height
    map_xy, fraction = cv2.convertMaps(maps[..., 0], maps[..., 1], cv2.CV_16SC2)
    size = (row, max(face.width for face in faces))
    return FaceLayout(
        tuple(faces), size, np.asarray(map_xy, np.int16), np.asarray(fraction, np.uint16), ~valid
    )


def _grid(camera: CentralCamera, stride: int) -> tuple[Array, Array, Mask]:
    """Return every ``stride``-th pixel, its ray and whether it shows something."""
    v, u = np.mgrid[0 : camera.height : stride, 0 : camera.width : stride].astype(np.float64)
    pixels = np.stack([u, v], axis=-1)
    return pixels, *camera.unproject(pixels)


def _choose_views(camera: CentralCamera, rays: Array, valid: Mask) -> _Views:
    """Return one flat view, rings about the axis, or the sides of a cube, by field of view."""
    widest = np.degrees(np.arccos(np.clip(rays[valid][:, 2].min(), -1.0, 1.0)))
    if widest < _SINGLE_POLAR_DEG:
        _, y, z = np.eye(3)
        return _Views([_eye(z, -y)], np.where(valid, 0, -1))
    if camera.min_polar_deg > _RING_POLAR_DEG:
        return _rings(_best_rings(camera), rays, valid)
    return _cube(rays, valid)


class _Ring(NamedTuple):
    """Equal views round the optical axis, for polar angles from ``start_deg`` on."""

    start_deg: float
    sectors: int
    tilt_deg: float


def _rings(rings: list[_Ring], rays: Array, valid: Mask) -> _Views:
    polar = np.degrees(np.arccos(np.clip(rays[..., 2], -1.0, 1.0)))
    turns = np.arctan2(rays[..., 1], rays[..., 0]) / (2.0 * np.pi)
    owner = np.full(valid.shape, -1)
    rotations: list[Array] = []
    for ring in rings:
        here = valid & (polar >= ring.start_deg)
        sector = np.rint(turns[here] * ring.sectors).astype(int) % ring.sectors
        owner[here] = len(rotations) + sector
        rotations += [
            _ring_view(2.0 * np.pi * k / ring.sectors, np.radians(ring.tilt_deg))
            for k in range(ring.sectors)
        ]
    return _Views(rotations, owner)


def _ring_view(azimuth: float, tilt: float) -> Array:
    """Return the view whose own axis is at angle ``tilt`` from the optical axis."""
    axis = np.array([0.0, 0.0, 1.0])
    radial = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    ahead = np.sin(tilt) * radial + np.cos(tilt) * axis
    return _eye(ahead, np.cos(tilt) * radial - np.sin(tilt) * axis)


def _best_rings(camera: CentralCamera) -> list[_Ring]:
    """Return the two rings that need the fewest pixels.

    A mirror's resolution grows by several times from its inner to its outer circle: one ring
    would draw the inner part far too finely.
    """
    pixels, rays, valid = _grid(camera, _STRIDE)
    polar = np.degrees(np.arccos(np.clip(rays[..., 2], -1.0, 1.0)))
    azimuth = np.arctan2(rays[..., 1], rays[..., 0])

    def cheapest(inside: Mask, start_deg: float) -> tuple[float, _Ring]:
        costs = []
        for sectors in _RING_SECTORS:
            share = pixels[inside & (np.abs(azimuth) <= np.pi / sectors)]
            for tilt in _RING_TILTS_DEG:
                view = _ring_view(0.0, np.radians(tilt))
                face = _fit(camera, view, share, PixelOrigin(0.5, 0.5), 1.0, 0)
                cost = sectors * face.width * face.height
                costs.append((cost, _Ring(start_deg, sectors, tilt)))
        return min(costs)

    best: tuple[float, list[_Ring]] = (np.inf, [])
    for split in _RING_SPLITS_DEG:
        inner, outer = valid & (polar < split), valid & (polar >= split)
        if inner.any() and outer.any():
            (a, low), (b, high) = cheapest(inner, 0.0), cheapest(outer, split)
            best = min(best, (a + b, [low, high]), key=lambda found: found[0])
    return best[1] or [cheapest(valid, 0.0)[1]]


def _cube(rays: Array, valid: Mask) -> _Views:
    """Return the sides of a cube about the optical axis."""
    x, y, z = np.eye(3)
    views = [_eye(z, -y), _eye(x, -y), _eye(-x, -y), _eye(y, z), _eye(-y, -z), _eye(-z, -y)]
    axes = np.stack([-view[:, 2] for view in views], axis=-1)
    return _Views(views, np.where(valid, np.argmax(np.nan_to_num(rays) @ axes, axis=-1), -1))


def _eye(ahead: Array, up: Array) -> Array:
    return np.stack([np.cross(up, -ahead), up, -ahead], axis=-1)


def _plane(rays: Array, rotation: Array) -> Array:
    """Return the image points (..., 2) of rays at unit distance before an eye."""
    eye = rays @ rotation
    return eye[..., :2] / -eye[..., 2:]


def _fit(
    camera: CentralCamera,
    rotation: Array,
    pixels: Array,
    origin: PixelOrigin,
    detail: float,
    row: int,
) -> Face:
    """Return the face that holds image pixels (N, 2), at the resolution they need."""
    plane = _plane(camera.unproject(pixels)[0], rotation)
    scale = detail * _pixels_per_tangent(camera, rotation, pixels, plane)
    low, high = plane.min(axis=0), plane.max(axis=0)
    left = low[0] - (_RIM + origin.column) / scale[0]
    top = high[1] + (_RIM + origin.row) / scale[1]
    width = int(np.ceil((high[0] - left) * scale[0] - origin.column - 1e-6)) + 1 + _RIM
    height = int(np.ceil((top - low[1]) * scale[1] - origin.row - 1e-6)) + 1 + _RIM
    return Face(
        rotation,
        left=float(left),
        right=float(left + width / scale[0]),
        bottom=float(top - height / scale[1]),
        top=float(top),
        width=width,
        height=height,
        row=row,
    )


def _pixels_per_tangent(
    camera: CentralCamera, rotation: Array, pixels: Array, plane: Array
) -> Array:
    """Return the (2,) resolution at which the median pixel of the image is still resolved."""
    step = 0.5
    gradients = []
    for direction in np.eye(2):
        # Towards the image's centre, so that the neighbour has a ray too.
        sign = np.where(pixels @ direction > np.array([camera.cx, camera.cy]) @ direction, -1, 1)
        beside = pixels + step * sign[:, None] * direction
        gradients.append((_plane(camera.unproject(beside)[0], rotation) - plane) / step)
    per_pixel = np.hypot(gradients[0], gradients[1])
    return np.asarray(1.0 / np.nanquantile(per_pixel, 1.0 - _QUANTILE, axis=0))


def _columns_rows(plane: Array, face: Face, origin: PixelOrigin) -> NDArray[np.float32]:
    """Return where points (N, 2) at unit distance lie in a face's image (px)."""
    scale_x = face.width / (face.right - face.left)
    scale_y = face.height / (face.top - face.bottom)
    column = (plane[:, 0] - face.left) * scale_x - origin.column
    row = (face.top - plane[:, 1]) * scale_y - origin.row
    return np.stack([column, row], axis=-1).astype(np.float32)
