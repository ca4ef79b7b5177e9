"""Points of two views in planar motion: residuals of the epipolar constraint, and their noise.

`visctrl.geometry.epipolar_planar` says what m is. With x, y = (right, up)/forward the constraint is
rows · m = 0 with rows = (y_b x_a, −y_b, −y_a x_b, y_a), and noise of the points gives rows · m
the variance mᵀ Q m σ² with

    Q = [A, −x_a; −x_a, 1] ⊕ [B, −x_b; −x_b, 1],   A = x_a² + y_b²,   B = x_b² + y_a²,

so that Sampson's residual is r = rows · m / √(mᵀ Q m) and ∂r/∂m = (rows − rows · m/(mᵀ Q m) Q m)
/√(mᵀ Q m). Everything is done for several pairs of views, or several m of one pair, at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Vector = tuple[float, float, float, float]


def _quadratic_form() -> Array:
    """Return Q (4, 4, 5) by the spans that its elements are made of."""
    Q = np.zeros((4, 4, 5))
    Q[0, 0, 0] = Q[1, 1, 2] = Q[2, 2, 3] = Q[3, 3, 2] = 1.0
    Q[0, 1, 1] = Q[1, 0, 1] = Q[2, 3, 4] = Q[3, 2, 4] = -1.0
    return Q


#: Q m, flat, from m.
_SPREAD = _quadratic_form().reshape(4, 20)
#: mᵀ Q m from the products of m's elements that it contains.
_FIRST, _SECOND = np.nonzero(_quadratic_form().any(axis=-1))
_SUMMED = _quadratic_form()[_FIRST, _SECOND]


class LinearPoints(NamedTuple):
    """P pairs at one unit vector m each.

    frames : (P, 4, 4), m and three vectors that complete it to an orthonormal basis.
    residual : (P, N), r for unit noise of a coordinate.
    jacobian : (P, 3, N), its derivatives along the three.
    variance : (P, N), mᵀ Q m.
    """

    frames: Array
    residual: Array
    jacobian: Array
    variance: Array


class PointPairs:
    """Image points of N features in P pairs of views, and the products that all is made of.

    rows : (P, 4, N), the constraint's coefficients of m.
    spans : (P, 5, N), A, x_a, 1, B and x_b.

    Parameters
    ----------
    a, b : (P, 2, N) arrays
        (right, up)/forward; a leading axis may be missing where all pairs share the view.
    """

    def __init__(self, a: Array, b: Array) -> None:
        shape = np.broadcast_shapes(a.shape, b.shape)
        count, features = (1 if len(shape) == 2 else shape[0]), shape[-1]
        xa, ya, xb, yb = a[..., 0, :], a[..., 1, :], b[..., 0, :], b[..., 1, :]
        self._points = np.empty((count, 2, 2, features))
        self._points[:, 0], self._points[:, 1] = a, b
        self.rows = np.empty((count, 4, features))
        np.multiply(yb, xa, out=self.rows[:, 0])
        np.multiply(ya, xb, out=self.rows[:, 2])
        np.negative(self.rows[:, 2], out=self.rows[:, 2])
        self.rows[:, 1], self.rows[:, 3] = -yb, ya
        square = self._points * self._points
        self.spans = np.empty((count, 5, features))
        np.add(square[:, 0, 0], square[:, 1, 1], out=self.spans[:, 0])
        np.add(square[:, 1, 0], square[:, 0, 1], out=self.spans[:, 3])
        self.spans[:, 1], self.spans[:, 2], self.spans[:, 4] = xa, 1.0, xb
        length2 = square[:, :, 0] + square[:, :, 1] + 1.0
        self._lengths = np.sqrt(length2[:, 0] * length2[:, 1])
        self._heights = self._points[:, 0, 1] + self._points[:, 1, 1]

    @classmethod
    def of(cls, points_a: ArrayLike, points_b: ArrayLike) -> PointPairs:
        """Return one pair of points (N, 2)."""
        a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
        return cls(a.T, b.T)

    @property
    def features(self) -> int:
        """N."""
        return int(self.rows.shape[-1])

    def squared(self, m: Array) -> Array:
        """Return squared Sampson residuals (H, N) of the only pair for hypotheses m (H, 4)."""
        products = (m[:, _FIRST] * m[:, _SECOND]) @ _SUMMED
        variance = np.maximum(products @ self.spans[0], 1e-18)
        return np.asarray((m @ self.rows[0]) ** 2 / variance)

    def linearised(self, vectors: Sequence[Vector]) -> LinearPoints:
        """Return residuals and derivatives at each pair's m, or at several m of the only pair."""
        frames = np.array([(m, *complement(m)) for m in vectors])
        error = frames @ self.rows
        spread = frames @ (frames[:, 0] @ _SPREAD).reshape(-1, 4, 5) @ self.spans
        variance = np.maximum(spread[:, 0], 1e-18)
        scale = 1.0 / np.sqrt(variance)
        residual = error[:, 0] * scale
        pull = (residual * scale)[:, None]
        jacobian = (error[:, 1:] - pull * spread[:, 1:]) * scale[:, None]
        return LinearPoints(frames, residual, jacobian, variance)

    def noise_sums(self, axes: Array, weights: Array) -> tuple[Array, Array]:
        """Return Σ w aᵀ Q a and √Σ (w aᵀ Q a)² (P, K) of axes a (P, K, 4), weights w (P, N)."""
        products = (axes[..., _FIRST] * axes[..., _SECOND]) @ _SUMMED
        weighted = weights[:, None] * self.spans
        total = products @ weighted.sum(axis=2)[..., None]
        gram = weighted @ weighted.transpose(0, 2, 1)
        squares = ((products @ gram) * products).sum(axis=2)
        return total[..., 0], np.sqrt(np.maximum(squares, 0.0))

    def trace(self) -> Array:
        """Return Q's traces (P, N): the sum of aᵀ Q a over any orthonormal axes."""
        return np.asarray(self.spans[:, 0] + self.spans[:, 3] + 2.0)

    def parallax(self, vectors: Sequence[Vector]) -> Array:
        """Return the sines (P, N) of the angles at the points, negative for those behind the views.

        They are |a × b| of the unit rays by their components along, across and above the
        baseline. Those of points behind the views have a sum of both depths less than zero.
        """
        turns = []
        for c_a, s_a, c_b, s_b in vectors:
            a, b = 1.0 / max(math.hypot(c_a, s_a), 1e-300), 1.0 / max(math.hypot(c_b, s_b), 1e-300)
            turns.append(((c_a * a, s_a * a), (c_b * b, s_b * b)))
        cosines, sines = np.array(turns).transpose(2, 0, 1)[..., None]
        right, up = self._points[:, :, 0], self._points[:, ::-1, 1]
        along, across = cosines + sines * right, cosines * right - sines
        level = along[:, 0] * across[:, 1] - across[:, 0] * along[:, 1]
        lifted, beside = along * up, across * up
        upright, off = lifted[:, 0] - lifted[:, 1], beside[:, 0] - beside[:, 1]
        front = level * (across[:, 0] + across[:, 1]) + upright * self._heights
        size = np.sqrt(level * level + upright * upright + off * off) / self._lengths
        return np.asarray(np.copysign(size, front))


def complement(m: Vector) -> tuple[Vector, Vector, Vector]:
    """Return three orthonormal vectors orthogonal to the unit vector m."""
    p, q, r, s = m
    return (-q, p, -s, r), (-r, s, p, -q), (-s, -r, q, p)
