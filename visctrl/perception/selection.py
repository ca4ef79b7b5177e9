"""Which features to use: few that are spread all round beat many in one corner."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def spread(
    points: ArrayLike, quality: ArrayLike, count: int, shape: tuple[int, int]
) -> NDArray[np.intp]:
    """Choose up to ``count`` points of good quality, spread over an image.

    The image is cut into about ``count`` square cells; every cell gives its best point before
    any gives its second best.

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
    (M,) numbers of the chosen points, M ≤ ``count``, best first.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    quality = np.asarray(quality, dtype=np.float64)
    rows, columns = shape
    side = max(1.0, float(np.sqrt(rows * columns / max(count, 1))))
    across, down = (points // side).astype(np.intp).T
    cell = down * (int(columns / side) + 1) + across
    order = np.lexsort((-quality, cell))
    in_order = cell[order]
    starts = np.flatnonzero(np.r_[True, in_order[1:] != in_order[:-1]])[: len(order)]
    rank = np.empty(len(order), dtype=np.intp)
    lengths = np.diff(np.r_[starts, len(order)])
    rank[order] = np.arange(len(order)) - np.repeat(starts, lengths)
    return np.lexsort((-quality, rank))[:count]
