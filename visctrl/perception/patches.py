"""Alignment of many small patches with a reference image at once: affine, blind to lighting.

Frame-to-frame tracking adds up small errors; a patch compared with the picture in which its
feature was found does not. Inverse-compositional Lucas–Kanade (Baker & Matthews, 2004) with an
affine warp (Shi & Tomasi, 1994), so that a patch may be seen from nearer or farther, on
intensities normalised to zero mean and unit norm, so that gain and offset do not matter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Grey = NDArray[np.uint8]
Indices = NDArray[np.intp]

#: Half the side of a patch (px); the patch has 2·6 + 1 pixels a side.
HALF = 6
# Damping of the affine part, against the information of a well textured patch of about 4: what
# the texture says little about stays as it was.
_DAMPING = np.array([1e-9, 0.1, 0.1] * 2)
# Step (px) after which a patch is left alone.
_SETTLED_PX = 0.08
# Deviation (grey levels) up to which a patch counts as flat.
_FLAT = np.float32(0.5)
# Longest step of an iteration: of the place (px) and of the warp.
_LONGEST = np.array([1.5, 0.15, 0.15])

_side = np.arange(-HALF, HALF + 1, dtype=np.float64)
# Offsets (2, S) of a patch's pixels from its centre.
_OFFSETS = np.stack([across.ravel() for across in np.meshgrid(_side, _side)])
_WEIGHTS = np.exp(-(_OFFSETS**2).sum(axis=0) / (2 * (0.85 * HALF) ** 2))
_WEIGHTS = (_WEIGHTS / _WEIGHTS.sum()).astype(np.float32)
_ROOT = np.sqrt(_WEIGHTS)
# What a gradient is summed with: 1 for the place, the offsets for the warp (S, 3).
_MOMENTS = np.stack([np.ones_like(_WEIGHTS), *_OFFSETS.astype(np.float32)], axis=1)
# Nine places (2, 9) of a patch, and the quadratic interpolation (9, S) from them.
_t = _side / HALF
_lagrange = np.stack([_t * (_t - 1.0) / 2.0, 1.0 - _t**2, _t * (_t + 1.0) / 2.0])
_NINE = HALF * np.stack([n.ravel() for n in np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0])])
_BETWEEN = np.einsum("ir,jc->ijrc", _lagrange, _lagrange).reshape(9, -1).astype(np.float32)


@dataclass(frozen=True)
class Source:
    """An image that patches are taken from.

    image : (rows, columns) uint8.
    pixels : callable
        Returns at which of its columns and rows (N, M) lie the columns and rows (N, M) of the
        points that patches are made of.
    """

    image: Grey
    pixels: Callable[[Floats, Floats], tuple[Floats, Floats]] = lambda columns, rows: (columns, rows)

    def sample(self, points: Array, warps: Array) -> Floats:
        """Return the grey levels (N, S) under warped patches.

        The map is followed exactly at nine places of a patch, quadratically between them.
        """
        nine = (points[:, :, None] + warps @ _NINE).astype(np.float32)
        x, y = (across @ _BETWEEN for across in self.pixels(nine[:, 0], nine[:, 1]))
        grey = cv2.remap(self.image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(grey, dtype=np.float32)


@dataclass(frozen=True)
class Alignment:
    """Where patches of a reference are found.

    points : (N, 2) centres in the image searched.
    warps : (N, 2, 2) maps of offsets in the reference to offsets in the image.
    score : (N,) correlation of the two patches, 1 for identical up to gain and offset.
    """

    points: Array
    warps: Array
    score: Array


class Patches:
    """Patches cut from reference images, ready to be aligned in others.

    Parameters
    ----------
    source : Source
    points : (N, 2) centres, sub-pixel.
    """

    def __init__(self, source: Source, points: Array) -> None:
        eye = np.broadcast_to(np.eye(2), (len(points), 2, 2))
        centred, deviation = _centred(source.sample(points, eye))
        template = centred / deviation
        right, up = (
            source.sample(points + step, eye) - source.sample(points - step, eye)
            for step in np.eye(2) / 2.0
        )
        # The gradients and the template of each patch, times the weights of its pixels.
        self._rows = np.stack([right / deviation, up / deviation, template], axis=1) * _WEIGHTS
        steepest = self._rows[:, :2, None] / _ROOT * _MOMENTS.T
        steepest = steepest.reshape(len(points), 6, -1).astype(np.float64)
        # What a change of offset or gain explains is none of the warp's business.
        template = template * _ROOT
        by_gain = steepest @ template[:, :, None]
        steepest -= (steepest @ _ROOT)[:, :, None] * _ROOT + by_gain * template[:, None]
        normal = steepest @ steepest.transpose(0, 2, 1) + np.diag(_DAMPING)
        inverse = np.linalg.inv(normal)
        self._solve = np.concatenate([inverse, -inverse @ by_gain], axis=2)

    def joined(self, other: Patches) -> Patches:
        """Return these patches and others, whose numbers follow."""
        both = object.__new__(Patches)
        both._rows = np.concatenate([self._rows, other._rows])
        both._solve = np.concatenate([self._solve, other._solve])
        return both

    def align(
        self, source: Source, which: Indices, points: Array, warps: Array, iterations: int = 4
    ) -> Alignment:
        """Align some patches with an image.

        Parameters
        ----------
        source : Source
            The image searched.
        which : (M,) numbers of the patches.
        points : (M, 2), warps : (M, 2, 2)
            Where to start.
        iterations : int

        Returns
        -------
        Alignment
            Of the M patches, in their order. A patch that was led astray has a low score.
        """
        points, warps, score = points.copy(), warps.copy(), np.zeros(len(which))
        moving = np.arange(len(which))
        for _ in range(iterations):
            if len(moving) == 0:
                break
            number, warp = which[moving], warps[moving]
            centred, deviation = _centred(source.sample(points[moving], warp))
            # Of the gradients and the template with the grey levels; of the last only the first.
            moments = (self._rows[number] * centred[:, None]).reshape(-1, len(_WEIGHTS)) @ _MOMENTS
            moments = (moments.reshape(-1, 9)[:, :7] / deviation)[:, :, None]
            step = (self._solve[number] @ moments).reshape(-1, 2, 3)
            step = np.clip(step, -_LONGEST, _LONGEST)
            score[moving] = moments[:, 6, 0]
            # To first order, the inverse of the step before the warp.
            warps[moving] = warp = warp - warp @ step[:, :, 1:]
            points[moving] -= (warp @ step[:, :, :1])[:, :, 0]
            # Where the step is small, the next would be smaller than the noise.
            moving = moving[(step[:, :, 0] ** 2).sum(axis=1) > _SETTLED_PX**2]
        return Alignment(points, warps, score)


def _centred(grey: Floats) -> tuple[Floats, Floats]:
    """Return patches (N, S) less their means, and their standard deviations (N, 1)."""
    centred = grey - (grey @ _WEIGHTS)[:, None]
    return centred, np.sqrt(np.maximum((centred * centred) @ _WEIGHTS, _FLAT**2))[:, None]
