"""Pyramidal Lucas–Kanade from one picture to the next, and the test of the way back."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.perception.pictures import Picture
from visctrl.perception.unwrap import Canvas

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Window (columns, rows) and pyramid levels above the small picture. OpenCV takes eight pixels of
# a row at once: 15 by 15 would take twice the time and lead no nearer.
_WINDOW, _LEVELS = (8, 16), 3
_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.05)
# A correlation lower than this is no shift of the whole picture.
_CLEAR_PEAK = 0.35


def follow(
    previous: Picture, current: Picture, points: Array, canvas: Canvas
) -> tuple[Array, Mask]:
    """Follow points from one picture to another.

    The search starts where the turn of the robot puts them, so that it need not be slow.

    Parameters
    ----------
    previous, current : Picture
    points : (N, 2) canvas points in ``previous``.
    canvas : Canvas
        On which the pictures are drawn.

    Returns
    -------
    moved : (N, 2) canvas points in ``current``.
    found : (N,) whether each was found at all.
    """
    if len(points) == 0:
        return points.copy(), np.zeros(0, dtype=np.bool_)
    across = np.array([shift(previous, current, canvas), 0.0])
    expected = canvas.canonical(points + across)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        previous.small,
        current.small,
        ((points + 0.5) / canvas.shrink - 0.5).astype(np.float32),
        ((expected + 0.5) / canvas.shrink - 0.5).astype(np.float32),
        winSize=_WINDOW,
        maxLevel=_LEVELS,
        criteria=_CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    moved = canvas.shrink * (np.asarray(moved, dtype=np.float64) + 0.5) - 0.5
    return canvas.canonical(moved), np.asarray(status[:, 0] > 0)


def returns(
    current: Picture,
    previous: Picture,
    moved: Array,
    points: Array,
    canvas: Canvas,
    tolerance: float,
) -> Mask:
    """Return whether tracking back leads to where each point came from.

    Parameters
    ----------
    current, previous : Picture
    moved, points : (N, 2) the points in ``current`` and where they were in ``previous``.
    canvas : Canvas
    tolerance : float
        Greatest distance (px).
    """
    back, found = follow(current, previous, moved, canvas)
    return np.asarray(found & (np.linalg.norm(back - points, axis=-1) <= tolerance))


def shift(previous: Picture, current: Picture, canvas: Canvas) -> float:
    """Return by how much (px) a picture on a canvas has moved to the right; 0 if it is unclear.

    Correlation of the coarse pictures along their rows; on the unwrap, the turn of the robot.
    """
    columns = previous.coarse.shape[1]
    likeness = np.fft.irfft((previous.waves.conj() * current.waves).sum(axis=0), columns)
    best = int(likeness.argmax())
    left, peak, right = likeness[[best - 1, best, (best + 1) % columns]].tolist()
    if peak < _CLEAR_PEAK:
        return 0.0
    across = best + 0.5 * (left - right) / (left - 2.0 * peak + right)
    across -= columns * round(across / columns)
    return float(canvas.shrink * canvas.coarseness * across)
