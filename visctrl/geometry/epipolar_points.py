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

from visctrl.geometry.robust_fit import products, side_by_side

Array = NDArray[np.float64]
Vector = tuple[float, float, float, float]


class LinearPoints(NamedTuple):
    """P unit vectors m with the N features of their pairs side by side.

    axes : for each pair three vectors that complete m to an orthonormal basis.
    residual : (P N,), r for unit noise of a coordinate.
    jacobian : (3, P N), its derivatives along the three.
    variance : (P N,), mᵀ Q m.
    """

    axes: list[tuple[Vector, Vector, Vector]]
    residual: Array
    jacobian: Array
    variance: Array


class PointPairs:
    """Image points of N features in P pairs of views, and the products that all is made of.

    Parameters
    ----------
    a, b : sequences of P arrays (2, N)
        (right, up)/forward. A view that several pairs share, or a pair of which several vectors
        m are asked for, is repeated.
    """

    def __init__(self, a: Sequence[Array], b: Sequence[Array]) -> None:
        self.features = a[0].shape[1]
        self._a, self._b = np.concatenate(a, axis=1), np.concatenate(b, axis=1)
        (xa, ya), (xb, yb) = self._a, self._b
        ones = np.ones(len(xa))
        self._rows = np.array([yb * xa, -yb, -ya * xb, ya])
        #: A, x_a, 1, B and x_b.
        self._spans = np.array([xa * xa + yb * yb, xa, ones, xb * xb + ya * ya, xb])
        self._row_blocks = side_by_side(np.split(self._rows, len(a), axis=1))
        self._span_blocks = side_by_side(np.split(self._spans, len(a), axis=1))
        self._lengths = np.sqrt((xa * xa + ya * ya + 1.0) * (xb * xb + yb * yb + 1.0))

    @classmethod
    def of(cls, points_a: ArrayLike, points_b: ArrayLike, vectors: int = 1) -> PointPairs:
        """Return one pair of points (N, 2), for one vector m or several."""
        a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
        return cls([a.T] * vectors, [b.T] * vectors)

    @property
    def rows(self) -> Array:
        """The constraint's coefficients (4, P N) of m."""
        return self._rows

    def squared(self, m: Array) -> Array:
        """Return squared Sampson residuals (H, N) of the first pair for hypotheses m (H, 4)."""
        rows, spans = self._rows[:, : self.features], self._spans[:, : self.features]
        c, s, c_b, s_b = m.T
        form = np.stack([c * c, -2.0 * c * s, s * s + s_b * s_b, c_b * c_b, -2.0 * c_b * s_b], -1)
        return np.asarray((m @ rows) ** 2 / np.maximum(form @ spans, 1e-18))

    def linearised(self, vectors: Sequence[Vector]) -> LinearPoints:
        """Return residuals and derivatives at each pair's m."""
        axes = [complement(m) for m in vectors]
        frames = [(m, *three) for m, three in zip(vectors, axes, strict=True)]
        # The same for each pair in its own columns: first m, then the three vectors across it.
        along = [[e for frame in frames for e in frame[k]] for k in range(4)]
        spread = [[e for f in frames for e in _form(f[0], f[k])] for k in range(4)]
        errors = np.array(along).dot(self._row_blocks)
        spreads = np.array(spread).dot(self._span_blocks)
        variance = np.maximum(spreads[0], 1e-18)
        scale = 1.0 / np.sqrt(variance)
        residual = errors[0] * scale
        pull = residual * scale
        jacobian = np.empty((3, len(scale)))
        for row, error, spread_k in zip(jacobian, errors[1:], spreads[1:], strict=True):
            np.multiply(error - pull * spread_k, scale, out=row)
        return LinearPoints(axes, residual, jacobian, variance)

    def traces(self) -> Array:
        """Return Q's traces (P N,): the sum of aᵀ Q a over any orthonormal axes."""
        return np.asarray(self._spans[0] + self._spans[3] + 2.0)

    def noise_sums(self, weights: Array, problems: int) -> list[NoiseSums]:
        """Return what the sums of w aᵀ Q a over each pair's features are made of.

        weights : (P N,), w.
        """
        weighted = self._spans * weights
        totals = weighted.reshape(5, problems, -1).sum(axis=2).T.tolist()
        squares = products(weighted, weighted, problems)
        return [NoiseSums(*sums) for sums in zip(totals, squares, strict=True)]

    def parallax(self, vectors: Sequence[Vector]) -> Array:
        """Return the sines (P N,) of the angles at the points, negative for those behind the views.

        They are |a × b| of the unit rays by their components along, across and above the
        baseline. Those of points behind the views have a sum of both depths less than zero.
        """
        cosines_sines = []
        for c_a, s_a, c_b, s_b in vectors:
            a, b = 1.0 / max(math.hypot(c_a, s_a), 1e-300), 1.0 / max(math.hypot(c_b, s_b), 1e-300)
            cosines_sines.append((c_a * a, s_a * a, c_b * b, s_b * b))
        c_a, s_a, c_b, s_b = np.repeat(np.array(cosines_sines).T, self.features, axis=1)
        (xa, ya), (xb, yb) = self._a, self._b
        a_along, a_across = c_a + s_a * xa, c_a * xa - s_a
        b_along, b_across = c_b + s_b * xb, c_b * xb - s_b
        level = a_along * b_across - a_across * b_along
        upright, off = a_along * yb - b_along * ya, a_across * yb - b_across * ya
        front = level * (a_across + b_across) + upright * (ya + yb)
        size = np.sqrt(level * level + upright * upright + off * off) / self._lengths
        return np.asarray(np.copysign(size, front))


class NoiseSums(NamedTuple):
    """Sums over features by the five spans that Q is made of: Σ w, and Σ w² of products."""

    totals: list[float]
    squares: list[list[float]]

    def along(self, axis: Vector) -> tuple[float, float]:
        """Return Σ w aᵀ Q a and √Σ (w aᵀ Q a)²."""
        form = _form(axis, axis)
        share = sum(f * t for f, t in zip(form, self.totals, strict=True))
        square = sum(
            f * sum(g * s for g, s in zip(form, row, strict=True))
            for f, row in zip(form, self.squares, strict=True)
        )
        return share, math.sqrt(max(square, 0.0))


def _form(u: Vector, v: Vector) -> tuple[float, float, float, float, float]:
    """Return the coefficients of the spans in uᵀ Q v."""
    return (
        u[0] * v[0],
        -u[0] * v[1] - u[1] * v[0],
        u[1] * v[1] + u[3] * v[3],
        u[2] * v[2],
        -u[2] * v[3] - u[3] * v[2],
    )


def complement(m: Vector) -> tuple[Vector, Vector, Vector]:
    """Return three orthonormal vectors orthogonal to the unit vector m."""
    p, q, r, s = m
    return (-q, p, -s, r), (-r, s, p, -q), (-s, -r, q, p)
