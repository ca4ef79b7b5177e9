"""Camera frames as pictures, with the features that were used drawn on them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Array
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Frame
from visctrl.robots.files import write_bytes

Image = NDArray[np.uint8]

#: Canvas of a frame that carries features only, and of what lies beside a picture (grey level).
_BLANK = 32
_MARK = (80, 220, 80)
_TRACK = (40, 170, 255)
#: Positions of tracks are given in parts of a pixel.
_SHIFT = 3
_SUBPIXELS = 1 << _SHIFT
_TEXT = (255, 255, 255)
#: Size of pictures that marks and letters are made for (px).
_REFERENCE_WIDTH = 800


def draw_frame(
    frame: Frame,
    camera: CentralCamera,
    pixels: Array,
    caption: str = "",
    tracks: Sequence[Array] = (),
) -> Image:
    """Return a frame as a colour picture with features marked.

    Parameters
    ----------
    frame : Frame
        With an image, or with features only: those are drawn on an empty canvas.
    camera : CentralCamera
        Its size is that of the canvas.
    pixels : (N, 2) array
        Features to mark.
    caption : str
        A line in the upper left corner.
    tracks : sequence of (K, 2) array
        Ways of features through the image.

    Returns
    -------
    (height, width, 3) uint8 array
        Blue, green, red.
    """
    if frame.image is None:
        grey = np.full((camera.height, camera.width), _BLANK, dtype=np.uint8)
    else:
        grey = frame.image
    picture: Image = np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    scale = picture.shape[1] / _REFERENCE_WIDTH
    radius = max(2, round(4 * scale))
    thickness = max(1, round(scale))
    for track in tracks:
        points = np.round(track[np.isfinite(track).all(axis=1)] * _SUBPIXELS).astype(np.int32)
        cv2.polylines(picture, [points], False, _TRACK, thickness, cv2.LINE_AA, _SHIFT)
    for u, v in np.asarray(pixels)[np.isfinite(pixels).all(axis=1)]:
        centre = (round(float(u)), round(float(v)))
        cv2.circle(picture, centre, radius, _MARK, thickness, cv2.LINE_AA)
    if caption:
        _write(picture, caption, scale)
    return picture


def save_picture(path: Path, picture: Image) -> None:
    """Write a picture as PNG.

    Raises
    ------
    OSError
        It cannot be written.
    """
    ok, data = cv2.imencode(".png", picture)
    if not ok:
        raise OSError(f"{path}: cannot be encoded as PNG")
    write_bytes(path, data.tobytes())


def _write(picture: Image, text: str, scale: float) -> None:
    font, size, width = cv2.FONT_HERSHEY_SIMPLEX, 0.6 * scale, max(1, round(scale))
    margin = round(8 * scale)
    (wide, high), below = cv2.getTextSize(text, font, size, width)
    picture[: high + below + 2 * margin, : wide + 2 * margin] //= 4
    origin = (margin, margin + high)
    cv2.putText(picture, text, origin, font, size, _TEXT, width, cv2.LINE_AA)
