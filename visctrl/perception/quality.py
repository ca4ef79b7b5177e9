"""How well a picture serves as a target view: features, their spread, sharpness, light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Frame
from visctrl.perception.image_perception import MARGIN_PX, ImagePerceptionOptions
from visctrl.perception.matching import describe
from visctrl.perception.pictures import averaged, checked, draw
from visctrl.perception.unwrap import Canvas, canvas_for

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

#: Width of the sectors in which features are counted (rad), and how many make one occupied.
_SECTOR = math.radians(30.0)
_FEATURES_PER_SECTOR = 3
#: Side of the box filter that sharpness is measured with (px).
_BOX_PX = 9


@dataclass(frozen=True)
class Quality:
    """Figures of a view.

    features : keypoints that can be described.
    pixels : (N, 2) where they are in the image.
    sectors : sectors of 30 deg of bearing that hold features; visible : those that could.
    sharpness : 0 (blurred) to 1 (sharp), whatever the contrast (see `sharpness`).
    mean, contrast : of the picture (grey levels).
    """

    features: int
    pixels: Array
    sectors: int
    visible: int
    sharpness: float
    mean: float
    contrast: float


def assess(frames: Sequence[Frame], camera: CentralCamera) -> Quality:
    """Measure a view of one pose, given one or several frames.

    Raises
    ------
    InputError
        A frame cannot be of this camera, or the frames show different things.
    """
    canvas = canvas_for(camera)
    image = averaged([checked(frame, camera, "the target image") for frame in frames], canvas)
    picture = draw(image, canvas)
    described = describe(picture.image, canvas, ImagePerceptionOptions().keypoints, MARGIN_PX)
    return Quality(
        features=len(described),
        pixels=camera.robot_pixels(described.rays)[0],
        sectors=_occupied(described.rays),
        visible=_visible(canvas),
        sharpness=sharpness(canvas.warp(image), canvas.field),
        mean=picture.mean,
        contrast=picture.contrast,
    )


def sharpness(image: Grey, field: Grey) -> float:
    """Return how much detail blurring takes from an image: 0 for none, towards 1 for most of it.

    A picture that is already blurred changes little when it is blurred again; the share of its
    variation between neighbours that is lost depends on neither contrast nor brightness (after
    Crété-Roffet et al., "The blur effect", 2007).

    Parameters
    ----------
    image, field : (rows, columns) uint8
        The picture, and where it shows something (> 0).
    """
    inner = np.asarray(cv2.erode(field, np.ones((_BOX_PX + 2, _BOX_PX + 2), np.uint8))) > 0
    worst = 1.0
    for axis in (0, 1):
        window = (1, _BOX_PX) if axis == 0 else (_BOX_PX, 1)
        blurred = cv2.blur(image.astype(np.float32), (window[1], window[0]))
        before = np.abs(np.diff(image.astype(np.float32), axis=1 - axis))
        after = np.abs(np.diff(blurred, axis=1 - axis))
        kept = inner[: before.shape[0], : before.shape[1]]
        total = float(before[kept].sum())
        lost = float(np.maximum(0.0, before - after)[kept].sum())
        worst = min(worst, lost / total if total > 0.0 else 0.0)
    return worst


def _occupied(rays: Array) -> int:
    """Return how many sectors hold enough features."""
    bearing = np.arctan2(rays[:, 0], rays[:, 1])
    sector = np.floor(bearing / _SECTOR).astype(int)
    return int((np.unique(sector, return_counts=True)[1] >= _FEATURES_PER_SECTOR).sum())


def _visible(canvas: Canvas) -> int:
    """Return how many sectors the canvas shows at least half of."""
    rows, columns = np.nonzero(canvas.mask)
    points = np.stack([columns, rows], axis=-1)[:: max(1, len(rows) // 20_000)]
    rays = canvas.rays(points)
    degrees = np.unique(np.floor(np.degrees(np.arctan2(rays[:, 0], rays[:, 1]))))
    _, shown = np.unique(np.floor(np.radians(degrees + 0.5) / _SECTOR), return_counts=True)
    return int((shown >= math.degrees(_SECTOR) / 2).sum())
