"""Alignment of many small patches with a reference image at once: affine, blind to lighting.

Frame-to-frame tracking adds up small errors; a patch compared with the picture in which its
feature was found does not. Inverse-compositional Lucas–Kanade (Baker & Matthews, 2004) with an
affine warp (Shi & Tomasi, 1994), so that a patch may be seen from nearer or farther, on
intensities normalised to zero mean and unit norm, so that gain and offset do not matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]
Values = NDArray[np.float32]

#: Half the side of a patch (px); the patch has 2·7 + 1 pixels a side.
HALF = 7
# Damping of the affine part, against the information of a well textured patch of about 4: what
# the texture says little about stays as it was.
_AFFINE_DAMPING = 0.1


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
    """Patches cut from one reference image, ready to be aligned in others.

    Parameters
    ----------
    image : (rows, columns) uint8
    points : (N, 2) centres, sub-pixel.
    """

    def __init__(self, image: Grey, points: Array) -> None:
        self.points = np.asarray(points, dtype=np.float64)
        side = np.arange(-HALF, HALF + 1, dtype=np.float64)
        dy, dx = np.meshgrid(side, side, indexing="ij")
        self._offsets = np.stack([dx.ravel(), dy.ravel()])
        self._weights = np.exp(-(self._offsets**2).sum(axis=0) / (2 * (0.6 * HALF) ** 2))
        self._weights /= self._weights.sum()
        self._root = np.sqrt(self._weights).astype(np.float32)
        self._build(prepared(image))

    def _build(self, image: Values) -> None:
        """Prepare the normalised templates and the normal equations of each patch."""
        n = len(self.points)
        eye = np.broadcast_to(np.eye(2), (n, 2, 2))
        grey = self._sample(image, self.points, eye)
        self._template, norm = self._normalised(grey)
        step = np.array([[0.5, 0.0], [0.0, 0.5]])
        after = (self._sample(image, self.points + shift, eye) for shift in step)
        before = (self._sample(image, self.points - shift, eye) for shift in step)
        gx, gy = (self._root * (b - a) / norm for a, b in zip(before, after, strict=True))
        dx, dy = self._offsets.astype(np.float32)
        steepest = np.stack([gx, gy, gx * dx, gx * dy, gy * dx, gy * dy], axis=1)
        # What a change of offset or gain explains is none of the warp's business.
        steepest -= (steepest @ self._root)[..., None] * self._root
        along = np.einsum("nks,ns->nk", steepest, self._template)
        steepest -= along[..., None] * self._template[:, None]
        self._steepest = steepest
        normal = np.einsum("nks,nls->nkl", steepest, steepest).astype(np.float64)
        normal[:, [2, 3, 4, 5], [2, 3, 4, 5]] += _AFFINE_DAMPING
        normal[:, [0, 1], [0, 1]] += 1e-9
        self._inverse = np.linalg.inv(normal).astype(np.float32)

    def align(
        self,
        image: Values,
        which: NDArray[np.intp],
        points: Array,
        warps: Array,
        iterations: int = 4,
    ) -> Alignment:
        """Align some patches with an image.

        Parameters
        ----------
        image : (rows, columns) float32
            The image searched, through `prepared`.
        which : (M,) numbers of the patches.
        points : (M, 2), warps : (M, 2, 2)
            Where to start.
        iterations : int

        Returns
        -------
        Alignment
            Of the M patches, in their order. A patch that was led astray has a low score.
        """
        if len(which) == 0:
            return Alignment(points, warps, np.zeros(0))
        points, warps = points.copy(), warps.copy()
        template = self._template[which]
        steepest, inverse = self._steepest[which], self._inverse[which]
        error = np.zeros_like(template)
        for _ in range(iterations):
            error = self._normalised(self._sample(image, points, warps))[0] - template
            step = np.einsum("nkl,nl->nk", inverse, np.einsum("nks,ns->nk", steepest, error))
            step = np.clip(step, [[-1.5] * 2 + [-0.15] * 4], [[1.5] * 2 + [0.15] * 4])
            warps = warps @ _inverse(np.eye(2) + step[:, 2:].reshape(-1, 2, 2))
            points -= np.einsum("nij,nj->ni", warps, step[:, :2])
        # The last step is too small to be worth another look.
        return Alignment(points, warps, 1.0 - 0.5 * (error**2).sum(axis=1).astype(np.float64))

    def _sample(self, image: Values, points: Array, warps: Array) -> Values:
        """Return the grey levels (N, S) under the warped patches."""
        at = points[:, :, None] + warps @ self._offsets
        xy = at.astype(np.float32)
        return np.asarray(
            cv2.remap(image, xy[:, 0], xy[:, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
            dtype=np.float32,
        )

    def _normalised(self, grey: Values) -> tuple[Values, Values]:
        """Return the patches (N, S), weighted, of zero mean and unit norm, and their norms."""
        centred = (grey - (grey @ self._weights.astype(np.float32))[:, None]) * self._root
        norm = np.sqrt((centred**2).sum(axis=1, keepdims=True)) + np.float32(0.5)
        return centred / norm, norm


def _inverse(A: Array) -> Array:
    """Return the inverses of matrices (N, 2, 2)."""
    (a, b), (c, d) = A[:, 0].T, A[:, 1].T
    adjugate = np.stack([d, -b, -c, a], axis=-1).reshape(-1, 2, 2)
    return np.asarray(adjugate / (a * d - b * c)[:, None, None], dtype=np.float64)


def prepared(image: Grey) -> Values:
    """Return an image ready for `Patches.align`: float, and a little smoothed."""
    return np.asarray(cv2.GaussianBlur(image, (5, 5), 0.8).astype(np.float32), dtype=np.float32)
