"""Distances from discs on the floor, looked up on a grid: many places, checked at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Distance of the grid's knots (m).
_KNOT_M = 0.04
#: By how much distances between knots are read too large at most (m), of more than 10 cm.
_ERROR_M = _KNOT_M**2 / (4.0 * 0.1)


class DistanceField:
    """Distances of points from the nearest disc, interpolated on a grid.

    Parameters
    ----------
    discs : (M, 3) array
        x, y, radius (m).
    reach : float
        Points farther than this from all discs need not be told from each other (m).
    """

    def __init__(self, discs: Array, reach: float) -> None:
        span = np.maximum(discs[:, 2:] + reach, 0.0) + 2.0 * _KNOT_M
        self._low = (discs[:, :2] - span).min(axis=0)
        high = (discs[:, :2] + span).max(axis=0)
        self._count = np.ceil((high - self._low) / _KNOT_M).astype(int) + 1
        x, y = (self._low[k] + np.arange(self._count[k]) * _KNOT_M for k in range(2))
        away = np.full(self._count, reach)
        for disc, half in zip(discs.tolist(), span[:, 0].tolist(), strict=True):
            rows, columns = (
                slice(*np.searchsorted(axis, (middle - half, middle + half)).tolist())
                for axis, middle in ((x, disc[0]), (y, disc[1]))
            )
            here = np.hypot(x[rows, None] - disc[0], y[None, columns] - disc[1]) - disc[2]
            np.minimum(away[rows, columns], here, out=away[rows, columns])
        self._away = away.ravel()

    def at(self, points: Array) -> Array:
        """Return lower bounds (...) of the distances of points (..., 2), at most the reach (m)."""
        place = (points - self._low) / _KNOT_M
        # What is outside reads what the edge does: the reach.
        place = np.clip(place, 0.0, self._count - 1.001)
        cell = place.astype(np.intp)
        x, y = np.moveaxis(place - cell, -1, 0)
        knot = cell[..., 0] * self._count[1] + cell[..., 1]
        low, high = self._away.take(knot), self._away.take(knot + self._count[1])
        near = low + x * (high - low)
        low, high = self._away.take(knot + 1), self._away.take(knot + self._count[1] + 1)
        far = low + x * (high - low)
        return np.asarray(near + y * (far - near) - _ERROR_M, dtype=np.float64)
