"""Image points of planar motion: residuals of the epipolar constraint, and their noise.

`planar_free` says what m is: here m = (cos θ, sin θ, κ cos α, κ sin α) but for
its length, with α = θ + φ and λ = ln κ. With the components of (x, 1) across and along the
baseline, and of y (1, 0),

    a⊥ = x_a cos θ − sin θ,   a∥ = x_a sin θ + cos θ,   a_c = y_b cos θ,   a_s = y_b sin θ,

and for view B κ times the same of x_b, y_a and α, the constraint and its gradient by the four
coordinates are

    e = y_b a⊥ − y_a b⊥ = 0,   g² = a⊥² + a_c² + b⊥² + b_c²,   r = e/g  (Sampson),

    ∂e/∂(θ, α, λ) = (−y_b a∥, y_a b∥, −y_a b⊥),
    ½ ∂g²/∂(θ, α, λ) = (−(a⊥ a∥ + a_c a_s), −(b⊥ b∥ + b_c b_s), b⊥² + b_c²),
    ∂r/∂(θ, α, λ) = (∂e/∂(θ, α, λ) − (r/g) ½ ∂g²/∂(θ, α, λ)) / g.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from visctrl.geometry.two_view.level_pairs import LevelPairs

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
#: (φ, θ, λ).
Lines = tuple[float, float, float]


class LinearPoints(NamedTuple):
    """P pairs of epipolar lines with the N features of their views side by side.

    residual : (P N,), r in units of ``unit``.
    jacobian : (3, P N), ∂r/∂(φ, θ, λ).
    a, b, a_lift, b_lift : (P N,), a⊥ + i a∥, b⊥ + i b∥, a_c + i a_s and b_c + i b_s.
    own : (2, P N), a⊥² + a_c² and b⊥² + b_c²: g² in two parts.
    mixed : (2, P N), a⊥ a∥ + a_c a_s and b⊥ b∥ + b_c b_s.
    """

    residual: Array
    jacobian: Array
    a: Complex
    b: Complex
    a_lift: Complex
    b_lift: Complex
    own: Array
    mixed: Array

    @property
    def gradient2(self) -> Array:
        """(P N,), g²."""
        return np.asarray(self.own[0] + self.own[1])

    def noise(self) -> Array:
        """Return what pixel noise makes of ∂e/∂m, as six products (6, P N) in σ².

        With unit vectors along the baselines and across them, they are those of the changes
        across a and a, b and b, across and along a, across and along b, along a and a, b and b.
        """
        across_a = self.a.imag**2 + self.a_lift.imag**2
        across_b = self.b.imag**2 + self.b_lift.imag**2
        return np.concatenate([[across_a, across_b], self.mixed, self.own])


class PointPairs(LevelPairs):
    """Image points of features in pairs of views, as rays (x, 1, y) of different lengths."""

    def __init__(self, a: Array, b: Array) -> None:
        """Take points (right, up)/forward, (P, 2, N) and (P, 2, N) or (2, N)."""
        super().__init__(_rays(a), _rays(b))
        self._counted_from = np.zeros((self.pairs, 1))

    @classmethod
    def of(cls, points_a: ArrayLike, points_b: ArrayLike, lines: int = 1) -> PointPairs:
        """Return one pair of points (N, 2), once for each of several epipolar lines."""
        a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
        return cls(np.array([a.T] * lines), b.T)

    def look(self, b: Array) -> None:
        """Put other rays in the place of view B's."""
        super().look(b)
        level = self._level.real.reshape(2, -1)
        lengths2 = level * level + self._up.reshape(2, -1) ** 2 + 1.0
        #: Q's trace: the noise of ∂e/∂m along any orthonormal axes in all.
        self.trace = lengths2[0] + lengths2[1]
        self._lengths = np.sqrt(lengths2[0] * lengths2[1])

    def see(self, b: Array) -> None:
        """Put other points, (P, 2, N) or (2, N), in the place of view B's."""
        self.look(_rays(b))

    def count_from(self, heights: Sequence[float]) -> None:
        """Count each pair's heights from another row, by its height over the present one."""
        rows = np.array(heights)[:, None]
        self._up += self._counted_from - rows
        self._counted_from = rows

    def linearised(self, lines: Sequence[Lines], unit: float = 1.0) -> LinearPoints:
        """Return residuals in units of ``unit`` and derivatives at each pair's (φ, θ, λ)."""
        turns = [cmath.rect(1.0, theta) for _, theta, _ in lines]
        turns += [cmath.rect(math.exp(scale), theta + phi) for phi, theta, scale in lines]
        factors = np.array(turns).reshape(2, -1, 1)
        a, b = (self._level * factors).reshape(2, -1)
        # The heights of the other view move with each view's baseline.
        a_lift, b_lift = (self._up[::-1] * factors).reshape(2, -1)
        depth_b = self.a_up * b.real
        error = self.b_up * a.real - depth_b
        own, mixed = np.empty((2, len(error))), np.empty((2, len(error)))
        for row, cross, z, lift in ((own[0], mixed[0], a, a_lift), (own[1], mixed[1], b, b_lift)):
            np.add(z.real * z.real, lift.real * lift.real, out=row)
            np.add(z.real * z.imag, lift.real * lift.imag, out=cross)
        inverse = 1.0 / np.maximum(own[0] + own[1], 1e-18)
        scale = np.sqrt(inverse) * (1.0 / unit)
        pull = error * inverse
        by_theta = pull * mixed[0] - self.b_up * a.imag
        by_alpha = pull * mixed[1] + self.a_up * b.imag
        jacobian = np.empty((3, len(error)))
        np.multiply(by_alpha, scale, out=jacobian[0])
        np.multiply(by_theta + by_alpha, scale, out=jacobian[1])
        np.multiply(pull * own[1] + depth_b, -scale, out=jacobian[2])
        return LinearPoints(error * scale, jacobian, a, b, a_lift, b_lift, own, mixed)

    def parallax(self, lines: Sequence[Lines]) -> Array:
        """Return the sines (P N,) of the angles at the points, negative for those behind.

        They are |a × b| of the unit rays by their components along, across and above the baseline.
        """
        a, b = self.turned(lines)
        level = a.imag * b.real - a.real * b.imag
        upright = self.b_up * a.imag - self.a_up * b.imag
        off = self.b_up * a.real - self.a_up * b.real
        front = level * (a.real + b.real) + upright * self._heights
        size = np.sqrt(level * level + upright * upright + off * off) / self._lengths
        return np.asarray(np.copysign(size, front))


def squared_residuals(points_a: Array, points_b: Array, m: Array) -> Array:
    """Return squared Sampson residuals (H, N) of points (N, 2) for hypotheses m (H, 4)."""
    (xa, ya), (xb, yb) = points_a.T, points_b.T
    c, s, c_b, s_b = m.T[:, :, None]
    across_a, across_b = c * xa - s, c_b * xb - s_b
    error = yb * across_a - ya * across_b
    gradient2 = across_a**2 + across_b**2 + (c * yb) ** 2 + (c_b * ya) ** 2
    return np.asarray(error * error / np.maximum(gradient2, 1e-18))


def _rays(points: Array) -> Array:
    """Return (x, 1, y) (..., 3, N) of points (..., 2, N)."""
    rays = np.ones((*points.shape[:-2], 3, points.shape[-1]))
    rays[..., ::2, :] = points
    return rays
