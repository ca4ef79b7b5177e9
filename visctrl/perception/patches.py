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

#: Half the side of a patch (px); the patch has 2·7 + 1 pixels a side.
HALF = 7
# Damping of the affine part, against the information of a well textured patch of about 4: what
# the texture says little about stays as it was.
_AFFINE_DAMPING = 0.1
# Deviation (grey levels) up to which a patch counts as flat.
_FLAT = np.float32(0.5)
# Longest step of an iteration: of the place (px) and of the warp.
_LONGEST = np.array([1.5] * 2 + [0.15] * 4)

_side = np.arange(-HALF, HALF + 1, dtype=np.float64)
# Offsets (2, S) of a patch's pixels from its centre.
_OFFSETS = np.stack([across.ravel() for across in np.meshgrid(_side, _side)])
_WEIGHTS = np.exp(-(_OFFSETS**2).sum(axis=0) / (2 * (0.6 * HALF) ** 2))
_WEIGHTS = (_WEIGHTS / _WEIGHTS.sum()).astype(np.float32)
_ROOT = np.sqrt(_WEIGHTS)
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
        Returns where in it the points (N, M, 2) lie that patches are made of.
    """

    image: Grey
    pixels: Callable[[Array], Floats] = np.float32

    def sample(self, points: Array, warps: Array) -> Floats:
        """Return the grey levels (N, S), less the middle one, under warped patches.

        The map is followed exactly at nine places of a patch, quadratically between them.
        """
        nine = points[:, None] + (warps @ _NINE).transpose(0, 2, 1)
        xy = self.pixels(nine).transpose(2, 0, 1) @ _BETWEEN
        border = cv2.BORDER_REPLICATE
        grey = cv2.remap(self.image, xy[0], xy[1], cv2.INTER_LINEAR, borderMode=border)
        return np.asarray(grey, dtype=np.float32) - np.float32(128.0)


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
        template, norm = _normalised(source.sample(points, eye))
        template *= _ROOT
        step = np.array([[0.5, 0.0], [0.0, 0.5]])
        after, before = (
            [source.sample(points + sign * shift, eye) for shift in step] for sign in (1, -1)
        )
        gx, gy = (_ROOT * (a - b) / norm for a, b in zip(after, before, strict=True))
        dx, dy = _OFFSETS.astype(np.float32)
        steepest = np.stack([gx, gy, gx * dx, gx * dy, gy * dx, gy * dy], axis=1)
        # What a change of offset or gain explains is none of the warp's business.
        steepest -= (steepest @ _ROOT)[..., None] * _ROOT
        along = np.einsum("nks,ns->nk", steepest, template)
        steepest -= along[..., None] * template[:, None]
        normal = np.einsum("nks,nls->nkl", steepest, steepest).astype(np.float64)
        normal[:, [2, 3, 4, 5], [2, 3, 4, 5]] += _AFFINE_DAMPING
        normal[:, [0, 1], [0, 1]] += 1e-9
        inverse = np.linalg.inv(normal).astype(np.float32)
        # Six rows that make a Gauss–Newton step of a patch, and one its correlation.
        self._rows = np.concatenate([inverse @ steepest, template[:, None]], axis=1) * _ROOT

    def joined(self, other: Patches) -> Patches:
        """Return these patches and others, whose numbers follow."""
        both = object.__new__(Patches)
        both._rows = np.concatenate([self._rows, other._rows])
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
        rows, score = self._rows[which], np.zeros(len(which))
        if len(which) == 0:
            return Alignment(points, warps, score)
        for _ in range(iterations):
            grey, _ = _normalised(source.sample(points, warps))
            found = (rows @ grey[:, :, None])[:, :, 0].astype(np.float64)
            step = np.clip(found[:, :6], -_LONGEST, _LONGEST)
            warps = warps @ _inverse(np.eye(2) + step[:, 2:].reshape(-1, 2, 2))
            points = points - (warps @ step[:, :2, None])[:, :, 0]
            # The last step is too small to be worth another look.
            score = found[:, 6]
        return Alignment(points, warps, score)


def _normalised(grey: Floats) -> tuple[Floats, Floats]:
    """Return patches (N, S) of zero mean and unit deviation, and their deviations (N, 1)."""
    centred = grey - (grey @ _WEIGHTS)[:, None]
    norm = np.sqrt(np.maximum((centred**2) @ _WEIGHTS, _FLAT**2))[:, None]
    return centred / norm, norm


def _inverse(A: Array) -> Array:
    """Return the inverses of matrices (N, 2, 2)."""
    (a, b), (c, d) = A[:, 0].T, A[:, 1].T
    adjugate = np.stack([d, -b, -c, a], axis=-1).reshape(-1, 2, 2)
    return np.asarray(adjugate / (a * d - b * c)[:, None, None], dtype=np.float64)
