"""What a target image can decide: how exactly it will tell arrival, and whether it has a twin."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.schemes.arrival.displacement import Depths, Sighting, displacement
from visctrl.schemes.arrival.image_target import ImageTarget

Grey = NDArray[np.uint8]

#: Directions (per turn) that a picture is compared in with itself turned; those nearer than the
#: patterns are wide do not count (rad); and the correlation from which it has a twin.
_COLUMNS, _ROWS, _NEAR, _TWIN = 180, 24, math.radians(30.0), 0.7
#: Elevations that are compared (rad).
_LOW, _HIGH = math.radians(-25.0), math.radians(25.0)


@dataclass(frozen=True)
class Decidability:
    """How well a target image will tell arrival.

    features : corners to judge by; floor : those of them that are low enough to be on the floor.
    position_sd, heading_sd : of the remaining error at the target (m, rad), for the depths that
        the floor gives or, without it, a usual room's; infinite where they cannot be told.
    twin : turn (rad) after which the target looks the same; None if there is none.
    """

    features: int
    floor: int
    position_sd: float
    heading_sd: float
    twin: float | None


def decidability(images: Sequence[Grey], camera: CentralCamera, height: float) -> Decidability:
    """Judge a target image by itself.

    Parameters
    ----------
    images : sequence of (height, width) uint8
        One or several pictures of one pose.
    camera : CentralCamera
    height : float
        The camera's over the floor (m).
    """
    target = ImageTarget(images, camera)
    position = heading = math.inf
    floor = 0
    if len(target) >= 3:
        same = target.compare(images[0])
        exact = Sighting(target.rays, same.current.whiten)
        depths = Depths.unknown(len(target)).with_floor(target.rays, height)
        floor = int(depths.floor.sum())
        left = displacement(target.rays, exact, depths)
        position, heading = left.distance_sd, left.heading_sd
    return Decidability(len(target), floor, position, heading, _twin(images[0], camera))


def _twin(image: Grey, camera: CentralCamera) -> float | None:
    """Return the turn after which a panoramic picture looks the same, if there is one."""
    if not camera.panoramic:
        return None
    bearing = np.arange(_COLUMNS) * 2.0 * math.pi / _COLUMNS
    elevation = np.linspace(_LOW, _HIGH, _ROWS)[:, None]
    flat = np.cos(elevation)
    rays = np.stack(
        np.broadcast_arrays(flat * np.sin(bearing), flat * np.cos(bearing), np.sin(elevation)), -1
    )
    points, seen = camera.robot_pixels(rays.reshape(-1, 3))
    smooth = cv2.GaussianBlur(image, (0, 0), camera.width / 200.0)
    x, y = np.nan_to_num(points, nan=-9.0).astype(np.float32).T
    drawn = cv2.remap(smooth, x[None], y[None], cv2.INTER_LINEAR).reshape(_ROWS, _COLUMNS)
    rows = drawn[seen.reshape(_ROWS, _COLUMNS).all(axis=1)].astype(np.float64)
    # What all directions have in common (floor dark, sky bright) tells no direction.
    rows -= rows.mean(axis=1, keepdims=True)
    power = float((rows**2).sum())
    if power <= 0.0:
        return None
    spectrum = np.abs(np.fft.rfft(rows, axis=1)) ** 2
    alike = np.fft.irfft(spectrum.sum(axis=0), _COLUMNS) / power
    turned = np.minimum(bearing, 2.0 * math.pi - bearing)
    alike[turned < _NEAR] = -1.0
    best = int(alike.argmax())
    return float(turned[best]) if alike[best] >= _TWIN else None
