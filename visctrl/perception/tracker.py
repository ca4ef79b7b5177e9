"""Pyramidal Lucas–Kanade from one picture to the next, there and back."""

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


def track(
    previous: Grey, current: Grey, points: Array, *, tolerance: float | None = 0.5
) -> tuple[Array, Mask]:
    """Follow points from one image to another.

    Parameters
    ----------
    previous, current : (rows, columns) uint8
    points : (N, 2) points in ``previous``.
    tolerance : float, optional
        Greatest distance (px) between a point and where tracking back from its new place
        leads. None leaves the way back out.

    Returns
    -------
    moved : (N, 2) points in ``current``.
    kept : (N,) whether the point was found and the way back agrees.
    """
    if len(points) == 0:
        return points.copy(), np.zeros(0, dtype=np.bool_)
    start = points.astype(np.float32).reshape(-1, 1, 2)
    moved, found = _follow(previous, current, start)
    if tolerance is not None:
        back, returned = _follow(current, previous, moved)
        found &= returned & (np.linalg.norm((back - start)[:, 0], axis=-1) <= tolerance)
    return moved[:, 0].astype(np.float64), found


def _follow(
    previous: Grey, current: Grey, points: NDArray[np.float32]
) -> tuple[NDArray[np.float32], Mask]:
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        previous,
        current,
        points,
        np.empty_like(points),
        winSize=(WINDOW, WINDOW),
        maxLevel=LEVELS,
        criteria=_CRITERIA,
    )
    return np.asarray(moved, dtype=np.float32), np.asarray(status[:, 0] > 0)
