"""Pyramidal Lucas–Kanade from one picture to the next, and the test of the way back."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Grey = NDArray[np.uint8]

#: Window side (px) and pyramid levels above the image: motions to about 60 px a frame.
WINDOW = 15
LEVELS = 3
_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)


def follow(previous: Grey, current: Grey, points: Array) -> tuple[Array, Mask]:
    """Follow points from one picture to another.

    Parameters
    ----------
    previous, current : (rows, columns) uint8
    points : (N, 2) points in ``previous``.

    Returns
    -------
    moved : (N, 2) points in ``current``.
    found : (N,) whether each was found at all.
    """
    if len(points) == 0:
        return points.copy(), np.zeros(0, dtype=np.bool_)
    start = points.astype(np.float32).reshape(-1, 1, 2)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        previous,
        current,
        start,
        np.empty_like(start),
        winSize=(WINDOW, WINDOW),
        maxLevel=LEVELS,
        criteria=_CRITERIA,
    )
    return moved[:, 0].astype(np.float64), np.asarray(status[:, 0] > 0)


def returns(current: Grey, previous: Grey, moved: Array, points: Array, tolerance: float) -> Mask:
    """Return whether tracking back leads to where each point came from.

    Parameters
    ----------
    current, previous : (rows, columns) uint8
    moved, points : (N, 2) the points in ``current`` and where they were in ``previous``.
    tolerance : float
        Greatest distance (px).
    """
    back, found = follow(current, previous, moved)
    return np.asarray(found & (np.linalg.norm(back - points, axis=-1) <= tolerance))
