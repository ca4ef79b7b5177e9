"""Generated, seeded surface patterns with features at every scale.

A pattern has content from a few millimetres to the size of its surface (1/f noise under
polygons of all sizes), because a feature must be found from half a metre as from fifteen. A
nearest-texel renderer shows it without aliasing only if it is band-limited to the image's
resolution at its distance, so each pattern comes in levels of halving resolution.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.sim.render.reliefs import Kind, relief

Image = NDArray[np.uint8]
Plane = NDArray[np.float32]

#: Resolution at which patterns are made (texels per metre), unless they say otherwise.
BASE_DENSITY = 256.0
#: Blur of level 1 (texels at the base density).
_BASE_SIGMA = 1.4
#: Blur of the sharpest level, 0 (m); each next level doubles it.
FINEST_SIGMA_M = _BASE_SIGMA / 2 / BASE_DENSITY
#: Interpolated texels per texel that the content needs, for a renderer that shows the nearest
#: texel: it shows features out of place by a fraction of one.
NEAREST_TEXEL_FINENESS = 3.0
#: An oblique surface is coarser in one direction only. Its texture is chosen for a resolution that
#: is lower by this power of the angle's cosine: a compromise between both directions.
OBLIQUENESS = 0.75
#: Textures are not made larger than this (texels).
_MOST_TEXELS = 2e6
LEVELS = 6

_DARKEST, _BRIGHTEST = 8.0, 247.0


@dataclass(frozen=True)
class Pattern:
    """What a surface looks like.

    width_m, height_m : size of the surface.
    kind : see `visctrl.sim.render.reliefs.Kind`.
    shade, contrast : mean brightness and spread, as fractions of full scale.
    margin_m : width of a plain rim.
    name, seed : what the random content is made from.
    density : texels per metre; less for what is only seen from far away.
    """

    width_m: float
    height_m: float
    kind: Kind
    shade: float
    contrast: float
    margin_m: float
    name: str
    seed: int
    density: float = BASE_DENSITY

    def base(self) -> Plane:
        """Return the pattern at its density, in grey levels."""
        width = max(2, round(self.width_m * self.density))
        height = max(2, round(self.height_m * self.density))
        rng = np.random.default_rng([self.seed, zlib.crc32(self.name.encode())])
        height_map = np.tanh(relief(self.kind, rng, width, height, self.density))
        if self.margin_m > 0:
            height_map *= _rim(width, height, self.margin_m * self.density)
        grey = 255.0 * (self.shade + self.contrast * height_map)
        return np.asarray(np.clip(grey, _DARKEST, _BRIGHTEST), dtype=np.float32)


class Levels:
    """A pattern's band-limited levels, each made from the one before when it is first wanted."""

    def __init__(self, pattern: Pattern) -> None:
        self._base = pattern.base()
        self._filtered: list[Plane] = []

    def image(self, level: int, fineness: float) -> Image:
        """Return level ``level`` (0 is the sharpest, blurred by `FINEST_SIGMA_M`).

        It has ``fineness`` interpolated texels, along a line, for each that its content needs.
        """
        return _fine(self.plane(level), fineness if level else 2.0 * fineness)

    def plane(self, level: int) -> Plane:
        """Return level ``level`` in grey levels, at the resolution at which it was filtered."""
        if level == 0:
            return _blurred(self._base, _BASE_SIGMA / 2)
        while len(self._filtered) < level:
            if not self._filtered:
                self._filtered.append(_blurred(self._base, _BASE_SIGMA))
                continue
            # Variances add up: what is missing to twice the blur, before every other is dropped.
            last = _blurred(self._filtered[-1], _BASE_SIGMA * math.sqrt(3.0))
            self._filtered.append(_resized(last, 0.5))
        return self._filtered[level - 1]


def periodic_noise(rng: np.random.Generator, side: int) -> Plane:
    """Return square noise with amplitude 1/f and unit variance whose opposite edges fit."""
    spectrum = np.fft.rfft2(rng.standard_normal((side, side), dtype=np.float32))
    frequency = np.hypot(np.fft.rfftfreq(side)[None, :], np.fft.fftfreq(side)[:, None])
    frequency[0, 0] = np.inf
    noise = np.fft.irfft2(spectrum / frequency, s=(side, side))
    return np.asarray(noise / noise.std(), dtype=np.float32)


def _blurred(plane: Plane, sigma: float) -> Plane:
    blurred = cv2.GaussianBlur(plane, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, dtype=np.float32)


def _resized(plane: Plane, scale: float) -> Plane:
    height, width = plane.shape
    size = (max(2, round(width * scale)), max(2, round(height * scale)))
    # What a coarser grid could alias has been blurred away: interpolation is enough.
    return np.asarray(cv2.resize(plane, size, interpolation=cv2.INTER_CUBIC), dtype=np.float32)


def _fine(plane: Plane, scale: float) -> Image:
    """Return an image ``scale`` times as large, or as large as textures may be."""
    image = _resized(plane, min(scale, math.sqrt(_MOST_TEXELS / plane.size)))
    return np.asarray(np.clip(np.rint(image), 0, 255), dtype=np.uint8)


def _rim(width: int, height: int, margin: float) -> Plane:
    """Return a mask that falls from 1 to 0 towards the edges, within ``margin`` texels."""
    x = np.arange(width) + 0.5
    y = np.arange(height) + 0.5
    near = np.minimum(np.minimum(x, width - x)[None, :], np.minimum(y, height - y)[:, None])
    return np.asarray(np.clip(near / margin - 0.5, 0.0, 1.0), dtype=np.float32)
