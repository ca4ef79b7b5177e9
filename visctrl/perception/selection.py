"""Which features to use: few that are spread all round beat many in one corner."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Cells are made smaller until there are enough with something in them, but not below this (px):
# features nearer than that see the same thing.
_SMALLEST_CELL_PX = 6.0
_SHRINK = 0.85


def spread(
    points: ArrayLike, quality: ArrayLike, count: int, shape: tuple[int, int]
) -> NDArray[np.intp]:
    """Choose up to ``count`` points of good quality, spread over an image.

    The image is cut into square cells so small that about ``count`` of them have points; every
    cell gives its best point before any gives its second best.

    Parameters
    ----------
    points : (N, 2) array
        (column, row) of each.
    quality : (N,) array
        Higher is better.
    count : int
    shape : (rows, columns) of the image.

    Returns
    -------
    (M,) numbers of the chosen points, M = min(N, ``count``), best first.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    quality = np.asarray(quality, dtype=np.float64)
    cell = _cells(points, count, shape)
    order = np.lexsort((-quality, cell))
    _, starts, lengths = np.unique(cell[order], return_index=True, return_counts=True)
    rank = np.empty(len(order), dtype=np.intp)
    rank[order] = np.arange(len(order)) - np.repeat(starts, lengths)
    return np.lexsort((-quality, rank))[:count]


def _cells(points: NDArray[np.float64], count: int, shape: tuple[int, int]) -> NDArray[np.intp]:
    """Return the number of the cell that each point lies in."""
    rows, columns = shape
    side = float(np.sqrt(rows * columns / max(count, 1)))
    wanted = min(count, len(points))
    while True:
        across, down = (points // side).astype(np.intp).T
        cell = np.asarray(down * (int(columns / side) + 1) + across, dtype=np.intp)
        if side * _SHRINK < _SMALLEST_CELL_PX or len(np.unique(cell)) >= wanted:
            return cell
        side *= _SHRINK
