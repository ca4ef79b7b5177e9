"""The image row of the horizon, from two views of a robot that moves in the plane.

The planar epipolar constraint of `visctrl.geometry.epipolar_planar` counts heights from the row in
which the camera's own height appears. A wrong centre row or a camera that pitches a little shifts
it, and the epipoles with it. Features off that row do not fit any planar motion; the row that most
of them agree on is the right one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from visctrl.geometry.epipolar_planar import (
    PlanarEpipoles,
    ransac_planar_epipoles,
    refine_planar_epipoles,
    sampson_residuals,
)
from visctrl.plugins import Health

Array = NDArray[np.float64]

#: Rows tried first, as a part of the widest shift, and halvings of their distance afterwards.
_ROWS = np.linspace(-1.0, 1.0, 11)
_HALVINGS = 5
_HYPOTHESES = 48
#: A row that is off makes residuals of about this part of its distance: what is more is an outlier.
_RESIDUAL = 0.1
#: A residual counts at most this many standard deviations.
_GATE_SIGMAS = 4.0


class Horizon(NamedTuple):
    """Height of the horizon over its assumed row, for a unit focal length, and its deviation."""

    shift: float
    sd: float


def find_horizon(
    points_a: ArrayLike, points_b: ArrayLike, sigma: float, widest: float, *, seed: int = 0
) -> Horizon:
    """Return where the horizon is.

    Parameters
    ----------
    points_a, points_b : (N, 2) arrays
        (right, up)/forward of the same features in both views, by the assumed calibration.
    sigma : float
        Standard deviation of one coordinate.
    widest : float
        Greatest shift that is looked for.
    seed : int
        Of the random samples.
    """
    a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    rows = _Rows(a, b, seed)
    step = float(widest * (_ROWS[1] - _ROWS[0]))
    candidates = sorted((widest * _ROWS).tolist(), key=abs)
    best = rows.best(candidates, max(sigma, _RESIDUAL * step))
    for _ in range(_HALVINGS):
        step /= 2.0
        near = [shift for shift in (best - step, best, best + step) if abs(shift) <= widest]
        # Rows differ by residuals of about their distance: what is more is an outlier.
        best = rows.best(near, max(sigma, _RESIDUAL * step))
    return Horizon(best, _deviation(rows, best, step, sigma, widest))


class _Rows:
    """Motions and costs with the horizon in one row or another."""

    def __init__(self, a: Array, b: Array, seed: int) -> None:
        self._points = (a, b)
        self._seed = seed
        self._fits: dict[float, PlanarEpipoles] = {}

    def best(self, shifts: list[float], sigma: float) -> float:
        """Return the row that the features agree on most."""
        return min(shifts, key=lambda shift: self.cost(shift, sigma))

    def cost(self, shift: float, sigma: float) -> float:
        """Return the sum of the squared residuals in ``sigma``, each no more than the gate."""
        a, b = (points - [0.0, shift] for points in self._points)
        fit = self._fit(a, b, shift, sigma)
        if fit.health is Health.LOST:
            return float(len(a) * _GATE_SIGMAS**2)
        self._fits[shift] = fit
        residual, _ = sampson_residuals(a, b, fit.vector)
        return float(np.minimum((residual / sigma) ** 2, _GATE_SIGMAS**2).sum())

    def _fit(self, a: Array, b: Array, shift: float, sigma: float) -> PlanarEpipoles:
        """Return the motion over a row, near that over the nearest row before."""
        if self._fits:
            nearest = min(self._fits, key=lambda other: abs(other - shift))
            fit = refine_planar_epipoles(a, b, self._fits[nearest].vector, sigma)
            if fit.health is not Health.LOST:
                return fit
        return ransac_planar_epipoles(a, b, sigma, seed=self._seed, hypotheses=_HYPOTHESES)


def _deviation(rows: _Rows, best: float, step: float, sigma: float, widest: float) -> float:
    """Return how far the row can move before the features object, each unit of cost a variance."""
    least, distance = rows.cost(best, sigma), step
    while distance < widest:
        more = max(rows.cost(best + side * distance, sigma) for side in (-1.0, 1.0)) - least
        if more > 1.0:
            return distance / math.sqrt(more)
        distance *= 2.0
    return widest
