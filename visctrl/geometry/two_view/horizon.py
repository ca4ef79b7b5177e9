"""The image row of the horizon, from two views of a robot that moves in the plane.

The planar epipolar constraint of `planar_free` counts heights from the row in
which the camera's own height appears. A wrong centre row or a camera that pitches a little shifts
it, and the epipoles with it. Features off that row do not fit any planar motion; the row that most
of them agree on is the right one.

It is a fourth parameter of the fit of `planar_free_residuals`: with heights y − h,

    ∂e/∂h = b⊥ − a⊥,   ½ ∂g²/∂h = −(a_c cos θ + κ b_c cos α).

The fit begins in several rows at once, for it may end in another row than the best.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from visctrl.geometry.robust.least_squares import levenberg_marquardt
from visctrl.geometry.robust.soft_l1 import (
    KERNEL_SIGMAS,
    Delta,
    Normal,
    SoftL1Problem,
    options,
    products,
)
from visctrl.geometry.two_view.planar_free import MINIMUM_FEATURES, likely_lines
from visctrl.geometry.two_view.planar_free_residuals import PointPairs

Array = NDArray[np.float64]
#: (φ, θ, λ, h).
Level = tuple[float, float, float, float]

#: Rows to begin in, as a part of the widest shift.
_ROWS = (-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0)
_HYPOTHESES, _STEPS, _LONGEST_STEP = 48, 25, 0.3
#: A row that is off makes residuals of about this part of its distance.
_RESIDUAL = 0.1
#: The row is known when its information exceeds the noise's by this many deviations.
_SIGNIFICANCE = 5.0
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
        Greatest shift that is looked for; its deviation where nothing is found.
    seed : int
        Of the random samples.
    """
    a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    if len(a) < MINIMUM_FEATURES:
        return Horizon(0.0, widest)
    starts: list[Level] = []
    for row in _ROWS:
        shift = [0.0, row * widest]
        limit = _GATE_SIGMAS * max(sigma, _RESIDUAL * widest * (_ROWS[1] - _ROWS[0]))
        lines = likely_lines(a - shift, b - shift, limit, _HYPOTHESES, seed, 1)
        starts.append((*lines[0], shift[1]))
    pairs = PointPairs.of(a, b, len(starts))
    problem = _LevelProblem(pairs, KERNEL_SIGMAS * sigma)
    found = levenberg_marquardt(problem, starts, options(_STEPS, _LONGEST_STEP))
    linear, weights, _ = found.linear
    inside = [k for k, level in enumerate(found.evaluated) if abs(level[3]) <= widest]
    if not inside:
        return Horizon(0.0, widest)
    best = min(inside, key=lambda k: found.costs[k])
    sums = products(linear.jacobian * weights, linear.jacobian, pairs.pairs)[best]
    noise = (linear.noise * weights).reshape(pairs.pairs, -1)[best] / KERNEL_SIGMAS**2
    return Horizon(found.evaluated[best][3], min(widest, _deviation(np.array(sums), noise)))


class _LinearLevels(NamedTuple):
    """Residuals (P N,) in units of ``unit``, derivatives (4, P N) by (φ, θ, λ, h), noise.

    noise : (P N,), variance of ∂r/∂h in σ² that is due to pixel noise alone.
    """

    residual: Array
    jacobian: Array
    noise: Array

    @classmethod
    def of(cls, pairs: PointPairs, levels: list[Level], unit: float) -> _LinearLevels:
        """Return them at each pair's (φ, θ, λ, h)."""
        pairs.count_from([h for *_, h in levels])
        linear = pairs.linearised([(phi, theta, scale) for phi, theta, scale, _ in levels], unit)
        cosines = [
            (math.cos(theta), math.exp(scale) * math.cos(theta + phi))
            for phi, theta, scale, _ in levels
        ]
        c_a, c_b = np.repeat(np.array(cosines).T, pairs.features, axis=1)
        gradient2 = np.maximum(linear.gradient2, 1e-18)
        gradient = np.sqrt(gradient2)
        by_error = (linear.b.real - linear.a.real) / (unit * gradient)
        by_gradient = (linear.a_lift.real * c_a + linear.b_lift.real * c_b) / gradient2
        by_height = by_error + linear.residual * by_gradient
        noise = (c_a * c_a + c_b * c_b) / gradient2
        return cls(linear.residual, np.vstack([linear.jacobian, by_height]), noise)


class _LevelProblem(SoftL1Problem[Level, _LinearLevels]):
    """Epipolar lines and horizon (φ, θ, λ, h) of one pair of views from several starts."""

    def __init__(self, pairs: PointPairs, unit: float) -> None:
        super().__init__(_GATE_SIGMAS / KERNEL_SIGMAS)
        self._pairs, self._unit = pairs, unit

    def residuals(self, points: list[Level]) -> _LinearLevels:
        """Return residuals and derivatives at each start's (φ, θ, λ, h)."""
        return _LinearLevels.of(self._pairs, points, self._unit)

    def solve(self, normal: Normal, damping: float) -> tuple[Delta, float]:
        """Return the step, and −gᵀ δ (see the base)."""
        H, g = np.array(normal[:4]), np.array(normal[4])
        H += np.diag(damping * np.diag(H) + 1e-9 * max(float(np.trace(H)), 1e-12))
        delta = -np.linalg.solve(H, g)
        return tuple(delta.tolist()), -float(g @ delta)

    def moved(self, point: Level, step: Delta, part: float) -> Level:
        """Return (φ, θ, λ, h) after a part of a step."""
        phi, theta, scale, h = (p + part * d for p, d in zip(point, step, strict=True))
        return phi, theta, scale, h


def _deviation(information: Array, noise: Array) -> float:
    """Return the standard deviation of h by the information (4, 4) of (φ, θ, λ, h).

    ``noise`` is each feature's share of it that is due to noise alone: in identical views, all.
    """
    others = information[:3, :3] + 1e-9 * np.trace(information[:3, :3]) * np.eye(3)
    known = information[3, 3] - information[3, :3] @ np.linalg.solve(others, information[:3, 3])
    clear = float(known - noise.sum())
    if clear <= _SIGNIFICANCE * math.sqrt(2.0 * float(noise @ noise)):
        return math.inf
    return 1.0 / (KERNEL_SIGMAS * math.sqrt(clear))
