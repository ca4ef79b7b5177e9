"""Images of a flat picture held in front of a central camera, ray by ray."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

_MARGIN_PX = 4
#: How a picture is held and photographed: tilt (rad), grey level beside it, optics, sensor.
_MOST_TILT, _BACKGROUND, _BLUR_PX, _NOISE = 0.5, 110, 0.6, 2.0


def draw_plane(
    camera: CentralCamera,
    picture: Grey,
    size_m: tuple[float, float],
    rotation: Array,
    position: Array,
    background: Grey,
    samples: int = 5,
) -> Grey:
    """Return an image of a picture in space, drawn over a background.

    Every pixel is the mean of ``samples``² rays, each followed to the plane: no part of the
    projection is used, only its inverse, and no interpolation between pixels.

    Parameters
    ----------
    camera : CentralCamera
    picture : (rows, columns) uint8
        What the plane shows.
    size_m : (width, height)
        Of the plane (m).
    rotation, position : (3, 3), (3,) arrays
        The plane's axes (right, down, away) and its upper left corner, in camera axes.
    background : (height, width) uint8
        What is seen beside it; 0 outside the field of view is up to the caller.
    samples : int
        Rays per pixel, along a line.
    """
    left, top, right, bottom = _bounds(camera, size_m, rotation, position)
    if left >= right or top >= bottom:
        return background.copy()
    step = (np.arange(samples) + 0.5) / samples - 0.5
    u = (np.arange(left, right)[:, None] + step).ravel()
    v = (np.arange(top, bottom)[:, None] + step).ravel()
    rays, valid = camera.unproject(np.stack(np.meshgrid(u, v), axis=-1))
    a, b, c = np.moveaxis(rays @ rotation, -1, 0)
    at = position @ rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = at[2] / c
    x, y = distance * a - at[0], distance * b - at[1]
    hit = valid & (distance > 0) & (x >= 0) & (y >= 0) & (x < size_m[0]) & (y < size_m[1])
    rows, columns = picture.shape
    i = (np.where(hit, y, 0.0) / size_m[1] * rows).astype(np.intp)
    j = (np.where(hit, x, 0.0) / size_m[0] * columns).astype(np.intp)
    place = background[top:bottom, left:right]
    behind = np.kron(place, np.ones((samples, samples), np.uint8))
    fine = np.where(hit, picture[i, j], behind).astype(np.float64)
    blocks = fine.reshape(bottom - top, samples, right - left, samples)
    image = background.copy()
    image[top:bottom, left:right] = np.rint(blocks.mean(axis=(1, 3)))
    return image


def facing(direction: Array, roll: float, tilt: tuple[float, float]) -> Array:
    """Return axes (right, down, away) of a plane in a direction, rolled and tilted (rad)."""
    away = direction / np.linalg.norm(direction)
    other = np.eye(3)[2] if abs(away[2]) < 0.9 else np.eye(3)[1]
    right = np.cross(other, away)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(away, right), away], axis=1)
    turn, lean = (cv2.Rodrigues(np.array(v))[0] for v in ((0.0, 0.0, roll), (*tilt, 0.0)))
    return np.asarray(axes @ turn @ lean, dtype=np.float64)


def hold(
    camera: CentralCamera,
    picture: Grey,
    size_m: tuple[float, float],
    place: tuple[float, float, float],
    rng: np.random.Generator,
    samples: int = 4,
) -> Grey:
    """Return a noisy image of a picture held before a camera, turned and tilted at random.

    Parameters
    ----------
    place : (polar, azimuth, distance)
        Of its middle: angles from and about the optical axis (rad), distance (m).
    """
    polar, azimuth, distance = place
    s = np.sin(polar)
    direction = np.array([s * np.cos(azimuth), s * np.sin(azimuth), np.cos(polar)])
    lean = rng.uniform(-_MOST_TILT, _MOST_TILT, 2)
    axes = facing(direction, rng.uniform(-np.pi, np.pi), (lean[0], lean[1]))
    corner = distance * direction - axes @ np.array([size_m[0] / 2, size_m[1] / 2, 0.0])
    background = np.full((camera.height, camera.width), _BACKGROUND, np.uint8)
    clean = draw_plane(camera, picture, size_m, axes, corner, background, samples)
    return photographed(clean, _BLUR_PX, _NOISE, rng)


def photographed(image: Grey, blur_px: float, noise: float, rng: np.random.Generator) -> Grey:
    """Return an image as a sensor delivers it: blurred by the optics, with noise."""
    blurred = cv2.GaussianBlur(image, (0, 0), blur_px) if blur_px > 0.0 else image
    noisy = np.asarray(blurred, dtype=np.float64) + rng.normal(0.0, noise, image.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _bounds(
    camera: CentralCamera, size_m: tuple[float, float], rotation: Array, position: Array
) -> tuple[int, int, int, int]:
    """Return left, top, right, bottom (px) of what the plane can cover, ends excluded."""
    grid = np.stack(np.meshgrid(*(np.linspace(0.0, s, 40) for s in size_m)), axis=-1)
    points = grid @ rotation[:, :2].T + position
    pixels, valid = camera.project(points)
    if not valid.any():
        return 0, 0, 0, 0
    low = np.floor(pixels[valid].min(axis=0)).astype(int) - _MARGIN_PX
    high = np.ceil(pixels[valid].max(axis=0)).astype(int) + _MARGIN_PX + 1
    left, top = np.maximum(low, 0).tolist()
    right, bottom = np.minimum(high, (camera.width, camera.height)).tolist()
    return left, top, right, bottom
