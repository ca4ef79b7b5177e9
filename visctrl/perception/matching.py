"""The same features in two views that are far apart: SIFT and a planar-motion check."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.two_view.planar import PlanarMotion, ransac_planar_motion
from visctrl.perception.selection import spread
from visctrl.perception.unwrap import Canvas

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Grey = NDArray[np.uint8]

# Descriptors nearer than this share of the next best are distinctive (Lowe, 2004).
_RATIO = 0.8
# Half of SIFT's usual threshold: plain walls have weak features, and few beat none.
_CONTRAST = 0.02
# SIFT's positions scatter by about 0.3 px, more across a change of scale.
_POSITION_SIGMA_PX = 0.5


@dataclass(frozen=True)
class Described:
    """Keypoints with their descriptors.

    points : (N, 2) canvas points; rays : (N, 3); sizes : (N,) diameters (px);
    descriptors : (N, 128).
    """

    points: Array
    rays: Array
    sizes: Array
    descriptors: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.points)

    def subset(self, which: Indices | NDArray[np.bool_]) -> Described:
        """Return some of the keypoints."""
        return Described(
            self.points[which], self.rays[which], self.sizes[which], self.descriptors[which]
        )


_NOTHING = Described(
    np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 128), dtype=np.float32)
)


def describe(image: Grey, canvas: Canvas, count: int, margin: int) -> Described:
    """Find and describe keypoints, spread over the picture.

    Descriptors are taken upright: the robot stays on its wheels, so "up" is the same in every
    view, and not having to guess it makes them more distinctive.

    Parameters
    ----------
    image : (rows, columns) uint8, drawn on ``canvas``.
    count : int
        At most this many.
    margin : int
        Distance (px) to keep from the edge of the field of view.
    """
    sift = cv2.SIFT.create(contrastThreshold=_CONTRAST)
    kernel = np.ones((2 * margin + 1, 2 * margin + 1), dtype=np.uint8)
    inner = np.asarray(cv2.erode(canvas.field, kernel, borderValue=0), dtype=np.uint8)
    unique: dict[tuple[float, float, float], cv2.KeyPoint] = {}
    for k in sorted(sift.detect(image, canvas.mask & inner), key=lambda k: -k.response):
        x, y = k.pt
        upright = cv2.KeyPoint(x, y, k.size, 0.0, k.response, k.octave)
        unique.setdefault((x, y, k.size), upright)
    keypoints = list(unique.values())
    places = np.array([k.pt for k in keypoints]).reshape(-1, 2)
    strength = np.array([k.response for k in keypoints])
    chosen = spread(places, strength, count, canvas.shape)
    if len(chosen) == 0:
        return _NOTHING
    used, descriptors = sift.compute(image, [keypoints[i] for i in chosen])
    points = np.array([k.pt for k in used])
    sizes = np.array([k.size for k in used])
    return Described(points, canvas.rays(points), sizes, np.asarray(descriptors, np.float32))


def mutual_matches(a: Described, b: Described) -> tuple[Indices, Indices]:
    """Return the numbers in a and in b of keypoints that are each other's best match.

    The match from a to b must also be distinctive (ratio test).
    """
    if len(a) < 2 or len(b) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    # Squared distances by the inner product: one matrix product for all pairs.
    square_a = (a.descriptors**2).sum(axis=1)[:, None]
    square_b = (b.descriptors**2).sum(axis=1)[None]
    distance = square_a + square_b - 2.0 * (a.descriptors @ b.descriptors.T)
    best = np.argmin(distance, axis=1)
    two = np.partition(distance, 1, axis=1)
    distinct = two[:, 0] < _RATIO**2 * two[:, 1]
    mutual = np.argmin(distance, axis=0)[best] == np.arange(len(a))
    first = np.flatnonzero(distinct & mutual)
    return first, best[first]


def planar_inliers(rays_a: Array, rays_b: Array, canvas: Canvas, seed: int) -> PlanarMotion:
    """Return the planar motion of b in a that matched rays (N, 3) agree on (RANSAC)."""
    return ransac_planar_motion(rays_a, rays_b, _POSITION_SIGMA_PX / canvas.scale, seed=seed)
