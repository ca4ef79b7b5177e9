"""What optics and sensor do to an ideal image: blur, exposure, noise."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

#: Periods of the two waves that the exposure's gain is made of (s).
_GAIN_PERIODS_S = (7.3, 2.9)
_GAIN_SHARES = (0.6, 0.4)
#: An image's width over the standard deviation of the blur that stray light is.
_VEIL_WIDTHS = 10.0
#: Noise is cut from a sheet larger than the image by this, at a place drawn per frame (px).
_SHEET_MARGIN = 256


class Sensor:
    """Turns rendered images into a camera's pictures.

    Parameters
    ----------
    width, height : int
        Image size (px).
    noise : float
        Standard deviation of each pixel (grey levels), independent from frame to frame.
    blur_px : float
        Standard deviation of the Gaussian blur (px).
    exposure : float
        Amplitude of the gain's slow changes about 1.
    seed : int
        Of noise and exposure.
    veil : float
        Share of every pixel that is the mean of its wide surroundings (stray light).
    gain, gamma : float
        Of the exposure: a share s of full scale is shown as (gain s)^gamma.
    """

    def __init__(
        self,
        width: int,
        height: int,
        noise: float,
        blur_px: float,
        exposure: float,
        seed: int,
        *,
        veil: float = 0.0,
        gain: float = 1.0,
        gamma: float = 1.0,
    ) -> None:
        self._size = (height, width)
        self._blur_px = blur_px
        self._exposure = exposure
        self._veil = veil
        self._curve: Image | None = None
        if (gain, gamma) != (1.0, 1.0):
            shown = 255.0 * np.clip(gain * np.arange(256) / 255.0, 0.0, 1.0) ** gamma
            self._curve = np.rint(shown).astype(np.uint8)
        self._seed = seed
        rng = np.random.default_rng([seed, 0])
        self._phases = rng.uniform(0.0, 2.0 * np.pi, len(_GAIN_PERIODS_S))
        self._sheet: NDArray[np.int16] | None = None
        if noise > 0.0:
            sheet = rng.standard_normal(
                (height + _SHEET_MARGIN, width + _SHEET_MARGIN), dtype=np.float32
            )
            self._sheet = np.rint(noise * sheet).astype(np.int16)

    def expose(self, image: Image, stamp: float, sequence: int) -> Image:
        """Return the picture of an ideal image (H, W), taken at ``stamp`` (s).

        The same ``sequence`` number gives the same noise.
        """
        if self._blur_px > 0.0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), self._blur_px), np.uint8)
        if self._veil > 0.0:
            wide = cv2.GaussianBlur(image, (0, 0), self._size[1] / _VEIL_WIDTHS)
            image = np.asarray(cv2.addWeighted(image, 1.0 - self._veil, wide, self._veil, 0.0))
        if self._curve is not None:
            image = np.asarray(cv2.LUT(image, self._curve), np.uint8)
        if self._exposure > 0.0:
            image = np.asarray(cv2.convertScaleAbs(image, alpha=self.gain(stamp)), np.uint8)
        if self._sheet is None:
            return image
        rng = np.random.default_rng([self._seed, 1, sequence])
        row, column = rng.integers(0, _SHEET_MARGIN, 2)
        height, width = self._size
        noise = self._sheet[row : row + height, column : column + width]
        return np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), np.uint8)

    def gain(self, stamp: float) -> float:
        """Return the exposure's gain at a time (s)."""
        waves = zip(_GAIN_SHARES, _GAIN_PERIODS_S, self._phases, strict=True)
        return 1.0 + self._exposure * sum(
            share * math.sin(2.0 * math.pi * stamp / period + phase)
            for share, period, phase in waves
        )
