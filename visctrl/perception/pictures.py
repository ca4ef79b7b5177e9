"""Pictures that can be used, at one brightness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.errors import InputError
from visctrl.hal.types import Frame
from visctrl.perception.unwrap import Canvas, shrunk

Grey = NDArray[np.uint8]

# Standard brightness and contrast; nearly three deviations fit into 8 bits.
_MEAN, _SD = 128.0, 45.0
# A scene has more contrast than this (grey levels); sensor noise, averaged over blocks, has less.
_BLANK_SD = 3.0
# Frames of one pose are more alike than this, whatever the noise.
_SAME_POSE_CORRELATION = 0.7


@dataclass(frozen=True)
class Picture:
    """A frame and how it is drawn on the canvas, at standard brightness and contrast.

    frame : the camera's image as it came.
    small : (rows, columns) uint8, drawn at a size less by `Canvas.shrink`.
    coarse : the small picture as it came, float32, less again by `Canvas.coarseness`.
    mean, contrast : of the frame as it came, within the field of view (grey levels).
    """

    frame: Grey
    small: Grey
    coarse: NDArray[np.float32]
    mean: float
    contrast: float
    _canvas: Canvas
    _levels: Grey

    @cached_property
    def image(self) -> Grey:
        """The picture at full size, (rows, columns) uint8; drawn when it is first asked for."""
        return np.asarray(cv2.LUT(self._canvas.warp(self.frame), self._levels), dtype=np.uint8)

    @cached_property
    def waves(self) -> NDArray[np.complex64]:
        """Fourier transforms of the rows of the coarse picture, at zero mean and unit norm."""
        rows = (self.coarse - np.float32(self.mean)) * self._canvas.fading
        return np.asarray(np.fft.rfft(rows / np.linalg.norm(rows), axis=1), dtype=np.complex64)

    @property
    def blank(self) -> bool:
        """Whether there is nothing in it."""
        return self.contrast < _BLANK_SD

    @property
    def complaint(self) -> str:
        """What is wrong with a blank picture, and what to do."""
        return (
            f"is blank (mean {self.mean:.0f}, contrast {self.contrast:.1f} of 255): check the "
            "light, the lens and the exposure"
        )


def draw(image: Grey, canvas: Canvas) -> Picture:
    """Draw a camera image on a canvas and bring it to standard brightness and contrast.

    Lucas–Kanade compares grey levels, so that a change of exposure would look like motion.
    """
    drawn = canvas.small(image)
    # Averaged over blocks of pixels, sensor noise no longer passes for contrast.
    coarse = shrunk(drawn, canvas.coarseness)
    average, deviation = cv2.meanStdDev(coarse, mask=canvas.coarse_field)
    mean, contrast = float(average.item()), float(deviation.item())
    gain = _SD / max(contrast, _BLANK_SD)
    levels = np.clip(np.rint(_MEAN + gain * (np.arange(256) - mean)), 0, 255).astype(np.uint8)
    small = np.asarray(cv2.LUT(drawn, levels), dtype=np.uint8)
    return Picture(image, small, coarse.astype(np.float32), mean, contrast, canvas, levels)


def checked(frame: Frame, camera: CentralCamera, what: str) -> Grey:
    """Return a frame's image after checking that it can be of this camera.

    Raises
    ------
    InputError
        There is no image, or it has another size or type; ``what`` names it.
    """
    image = frame.image
    if image is None:
        raise InputError(
            f"{what} has no image, only identified features: use the perception 'features'"
        )
    if image.ndim != 2 or image.dtype != np.uint8:
        raise InputError(f"{what} is not an 8-bit grey image (shape {image.shape}, {image.dtype})")
    height, width = image.shape
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f"{what} is {width}x{height}, but camera '{camera.name}' takes "
            f"{camera.width}x{camera.height}: use an image taken with this camera, or choose the "
            "camera that took it"
        )
    return image


def averaged(images: Sequence[Grey], canvas: Canvas) -> Grey:
    """Return the mean of several camera images of one pose.

    Raises
    ------
    InputError
        One of them shows something else than the first: the camera moved.
    """
    first = draw(images[0], canvas)
    for number, image in enumerate(images[1:], start=2):
        if _correlation(first, draw(image, canvas), canvas) < _SAME_POSE_CORRELATION:
            raise InputError(
                f"target image {number} of {len(images)} differs from the first: take them all "
                "from one pose, with nothing moving"
            )
    return np.asarray(np.rint(np.mean(np.stack(images), axis=0)), dtype=np.uint8)


def _correlation(a: Picture, b: Picture, canvas: Canvas) -> float:
    """Return the correlation of two pictures within the field of view; 0 without contrast."""
    field = canvas.coarse_field > 0
    x, y = (p.coarse[field] - p.coarse[field].mean() for p in (a, b))
    norm = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / norm if norm > 0.0 else 0.0
