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
# Step (px) after which the next would be smaller than the noise.
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
    pixels: Callable[[Floats, Floats], tuple[Floats, Floats]]

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
    *views : (source, points)
        Images and the centres (N, 2), sub-pixel, of the patches to cut from each; the numbers of
        a view's patches follow those of the view before.
    """

    def __init__(self, *views: tuple[Source, Array]) -> None:
        rows, solve = zip(*(_cut(source, points) for source, points in views), strict=True)
        self._rows, self._solve = np.concatenate(rows), np.concatenate(solve)

    def align(
        self,
        source: Source,
        which: Indices,
        points: Array,
        warps: Array,
        iterations: int,
        settled_px: float = _SETTLED_PX,
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
            At most.
        settled_px : float
            A patch whose step is shorter is left alone.

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
            moving = moving[(step[:, :, 0] ** 2).sum(axis=1) > settled_px**2]
        return Alignment(points, warps, score)


def _cut(source: Source, points: Array) -> tuple[Floats, Array]:
    """Return what patches at points (N, 2) are aligned by.

    rows : (N, 3, S) the two gradients and the template, times the weights of the pixels.
    solve : (N, 6, 7) what a step is made with of the moments of the gradients (6) and of the
        template (1) with the grey levels seen.
    """
    eye = np.broadcast_to(np.eye(2), (len(points), 2, 2))
    centred, deviation = _centred(source.sample(points, eye))
    across, down = (
        source.sample(points + step, eye) - source.sample(points - step, eye)
        for step in np.eye(2) / 2.0
    )
    rows = np.stack([across, down, centred], axis=1) / deviation[:, None] * _WEIGHTS
    steepest = rows[:, :2, None] / _ROOT * _MOMENTS.T
    steepest = steepest.reshape(len(points), 6, -1).astype(np.float64)
    # What a change of offset or gain explains is none of the warp's business.
    template = rows[:, 2] / _ROOT
    by_gain = steepest @ template[:, :, None]
    steepest -= (steepest @ _ROOT)[:, :, None] * _ROOT + by_gain * template[:, None]
    inverse = np.linalg.inv(steepest @ steepest.transpose(0, 2, 1) + np.diag(_DAMPING))
    return rows, np.concatenate([inverse, -inverse @ by_gain], axis=2)


def _centred(grey: Floats) -> tuple[Floats, Floats]:
    """Return patches (N, S) less their means, and their standard deviations (N, 1)."""
    centred = grey - (grey @ _WEIGHTS)[:, None]
    return centred, np.sqrt(np.maximum((centred * centred) @ _WEIGHTS, _FLAT**2))[:, None]
