"""How well a patch can be located in an image, by the image's noise and the patch's texture.

A position found by alignment has the covariance σ² (Σ g gᵀ)⁻¹, with σ the noise of a pixel and g
the gradients under the patch (Förstner, 1982): its own standard, that no residual can widen.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.robust.scale import mad_sd
from visctrl.perception.patch_alignment import HALF
from visctrl.perception.unwrap import Canvas

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

#: Differences of second differences: blind to planes, twice over (Immerkær, 1996).
_RESIDUAL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
_RESIDUAL_NORM = 6.0
#: Noise of rounding to whole grey levels, and of what interpolation leaves (grey levels).
_LEAST_NOISE = 0.5
#: Variance of the gradient of unit noise: of a Sobel filter over 8 (12/64), less what
#: interpolation takes from the noise.
_NOISE_GRADIENT = 0.13
#: Share of a patch's pixels that count, weighted as the alignment weights them.
_EFFECTIVE = 0.6


def pixel_noise(image: Grey, field: Grey) -> float:
    """Return the standard deviation (grey levels) of an image's noise where ``field`` > 0."""
    residual = cv2.filter2D(image.astype(np.float32), -1, _RESIDUAL)
    shown = residual[np.asarray(field) > 0].astype(np.float64)
    return max(mad_sd(shown) / _RESIDUAL_NORM, _LEAST_NOISE) if len(shown) else _LEAST_NOISE


def position_deviations(image: Grey, canvas: Canvas, points: Array) -> Array:
    """Return the standard deviations (N,) of positions in their least certain direction (px).

    Parameters
    ----------
    image : (height, width) uint8
        The camera's image as it came.
    canvas : Canvas
    points : (N, 2) canvas points
    """
    drawn = canvas.warp(image)
    noise = pixel_noise(image, (image > 0).astype(np.uint8))
    grey = drawn.astype(np.float32) / 8.0
    across, down = (
        np.asarray(cv2.Sobel(grey, cv2.CV_32F, *order, ksize=3), dtype=np.float32)
        for order in ((1, 0), (0, 1))
    )
    side = 2 * HALF + 1
    sums = [
        cv2.GaussianBlur(product, (side, side), 0.85 * HALF)
        for product in (across * across, across * down, down * down)
    ]
    rows, columns = drawn.shape
    column, row = np.rint(points).astype(np.intp).T
    at = np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)
    xx, xy, yy = (_EFFECTIVE * side**2 * np.asarray(s, dtype=np.float64)[at] for s in sums)
    # The noise has gradients of its own, which locate nothing.
    weakest = (xx + yy) / 2.0 - np.hypot((xx - yy) / 2.0, xy)
    weakest -= _EFFECTIVE * side**2 * _NOISE_GRADIENT * noise**2
    return np.asarray(noise / np.sqrt(np.maximum(weakest, 1.0)), dtype=np.float64)
