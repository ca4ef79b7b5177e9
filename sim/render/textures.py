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
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Plane = NDArray[np.float32]
Kind = Literal["blobs", "noise", "plain", "checker"]

#: Resolution at which patterns are made (texels per metre).
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
#: Side of the squares of the pattern ``checker`` (m).
CHECK_M = 0.25

_DARKEST, _BRIGHTEST = 8.0, 247.0
_SMALLEST_BLOB_M = 0.04
#: Area of the polygons of one size, as a rough share of the whole.
_BLOB_COVER = 0.3


@dataclass(frozen=True)
class Pattern:
    """What a surface looks like.

    width_m, height_m : size of the surface.
    kind : ``blobs`` polygons over noise, ``noise`` alone, ``plain`` one shade, ``checker``
        black and white squares (for measuring, not for driving: it repeats itself).
    shade, contrast : mean brightness and spread, as fractions of full scale.
    margin_m : width of a plain rim.
    name, seed : what the random content is made from.
    """

    width_m: float
    height_m: float
    kind: Kind
    shade: float
    contrast: float
    margin_m: float
    name: str
    seed: int

    def base(self) -> Plane:
        """Return the pattern at `BASE_DENSITY`, in grey levels."""
        width = max(2, round(self.width_m * BASE_DENSITY))
        height = max(2, round(self.height_m * BASE_DENSITY))
        rng = np.random.default_rng([self.seed, zlib.crc32(self.name.encode())])
        match self.kind:
            case "blobs":
                relief = _blobs(rng, width, height) + 0.3 * _fractal_noise(rng, width, height)
            case "noise":
                relief = _fractal_noise(rng, width, height)
            case "checker":
                relief = _checker(width, height)
            case "plain":
                relief = np.zeros((height, width), np.float32)
        relief = np.tanh(relief)
        if self.margin_m > 0:
            relief *= _rim(width, height, self.margin_m * BASE_DENSITY)
        grey = 255.0 * (self.shade + self.contrast * relief)
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


def _fractal_noise(rng: np.random.Generator, width: int, height: int) -> Plane:
    """Return noise with equal variance in every octave (amplitude 1/f), of unit variance."""
    octaves = max(1, int(math.log2(max(width, height))) - 1)
    side = 2**octaves
    shape = (math.ceil(height / side) + 1, math.ceil(width / side) + 1)
    noise = rng.standard_normal(shape, dtype=np.float32)
    for _ in range(octaves):
        noise = _resized(noise, 2.0)
        noise += rng.standard_normal(noise.shape, dtype=np.float32)
    noise = noise[:height, :width]
    return np.asarray(noise / noise.std(), dtype=np.float32)


def _blobs(rng: np.random.Generator, width: int, height: int) -> Plane:
    """Return random polygons of all sizes, the large ones beneath, values about ±1."""
    canvas = np.zeros((height, width), np.float32)
    radius = 0.45 * min(width, height)
    while radius > _SMALLEST_BLOB_M * BASE_DENSITY:
        count = int(_BLOB_COVER * width * height / radius**2) + 1
        corners = rng.integers(3, 7, count)
        turns = np.sort(rng.uniform(0.0, 2.0 * np.pi, (count, 6)), axis=-1)
        reach = radius * rng.uniform(0.5, 1.0, (count, 6))
        centres = rng.uniform((0.0, 0.0), (width, height), (count, 2))
        points = centres[:, None] + reach[..., None] * np.stack([np.cos(turns), np.sin(turns)], -1)
        shades = rng.uniform(-1.4, 1.4, count).tolist()
        whole = np.rint(points).astype(np.int32)
        for polygon, corner, shade in zip(whole, corners, shades, strict=True):
            cv2.fillConvexPoly(canvas, polygon[:corner], shade)
        radius /= 2.0
    return canvas


def _checker(width: int, height: int) -> Plane:
    across = np.floor((np.arange(width) + 0.5) / (CHECK_M * BASE_DENSITY)).astype(int)
    down = np.floor((np.arange(height) + 0.5) / (CHECK_M * BASE_DENSITY)).astype(int)
    return np.where((across[None, :] + down[:, None]) % 2 == 0, 3.0, -3.0).astype(np.float32)


def _rim(width: int, height: int, margin: float) -> Plane:
    """Return a mask that falls from 1 to 0 towards the edges, within ``margin`` texels."""
    x = np.arange(width) + 0.5
    y = np.arange(height) + 0.5
    near = np.minimum(np.minimum(x, width - x)[None, :], np.minimum(y, height - y)[:, None])
    return np.asarray(np.clip(near / margin - 0.5, 0.0, 1.0), dtype=np.float32)
