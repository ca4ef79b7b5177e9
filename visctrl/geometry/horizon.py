"""The image row of the horizon, from two views of a robot that moves in the plane.

The planar epipolar constraint of `visctrl.geometry.epipolar_planar` counts heights from the row in
which the camera's own height appears. A wrong centre row or a camera that pitches a little shifts
it, and the epipoles with it. Features off that row do not fit any planar motion; the row that most
of them agree on is the right one.
"""

from __future__ import annotations

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
    costs: dict[float, float] = {}
    fits: dict[float, PlanarEpipoles] = {}

    def evaluate(shift: float, near: PlanarEpipoles | None = None) -> None:
        fits[shift] = _fit(a - [0.0, shift], b - [0.0, shift], sigma, seed, near)
        costs[shift] = _cost(a - [0.0, shift], b - [0.0, shift], sigma, fits[shift])

    for shift in (widest * _ROWS).tolist():
        evaluate(shift)
    step = float(widest * (_ROWS[1] - _ROWS[0]))
    for _ in range(_HALVINGS):
        step /= 2.0
        best = min(costs, key=costs.__getitem__)
        for shift in (best - step, best + step):
            if abs(shift) <= widest:
                evaluate(shift, fits[best])
    best = min(costs, key=costs.__getitem__)
    return Horizon(best, _deviation(costs, best, widest))


def _deviation(costs: dict[float, float], best: float, widest: float) -> float:
    """Return how far the row can move before the features object, each unit of cost a variance."""
    object_at = [
        abs(shift - best) / np.sqrt(cost - costs[best])
        for shift, cost in costs.items()
        if cost - costs[best] > 1.0
    ]
    return float(min(object_at, default=widest))


def _fit(
    a: Array, b: Array, sigma: float, seed: int, near: PlanarEpipoles | None
) -> PlanarEpipoles:
    if near is not None and near.health is not Health.LOST:
        return refine_planar_epipoles(a, b, near.vector, sigma)
    return ransac_planar_epipoles(a, b, sigma, seed=seed, hypotheses=_HYPOTHESES)


def _cost(a: Array, b: Array, sigma: float, fit: PlanarEpipoles) -> float:
    """Return the sum of the squared residuals in ``sigma``, each no more than the gate."""
    if fit.health is Health.LOST:
        return float(len(a) * _GATE_SIGMAS**2)
    residual, _ = sampson_residuals(a, b, fit.vector)
    return float(np.minimum((residual / sigma) ** 2, _GATE_SIGMAS**2).sum())
