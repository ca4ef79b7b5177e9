"""Points of two views in planar motion: residuals of the epipolar constraint, and their noise.

`visctrl.geometry.epipolar_planar` says what m is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def _quadratic_form() -> Array:
    """Return the Q of `_Pair` (4, 4, 5) by the spans that its elements are made of."""
    Q = np.zeros((4, 4, 5))
    Q[0, 0, 0] = Q[1, 1, 2] = Q[2, 2, 3] = Q[3, 3, 2] = 1.0
    Q[0, 1, 1] = Q[1, 0, 1] = Q[2, 3, 4] = Q[3, 2, 4] = -1.0
    return Q


#: Q m, flat, from m.
_SPREAD = _quadratic_form().reshape(4, 20)
#: mᵀ Q m from the products of m's elements that it contains.
_FIRST, _SECOND = np.nonzero(_quadratic_form().any(axis=-1))
_SUMMED = _quadratic_form()[_FIRST, _SECOND]


class PointPair:
    """Points of two views, and the products of their coordinates that everything is made of.

    Noise of the points gives a row of the constraint times m the variance mᵀ Q m σ² with
    Q = [A, −x_a; −x_a, 1] ⊕ [B, −x_b; −x_b, 1], A = x_a² + y_b², B = x_b² + y_a².

    rows : (4, N), the constraint's coefficients of m.
    spans : (5, N), A, x_a, 1, B and x_b.
    """

    def __init__(self, a: Array, b: Array, rows: Array, spans: Array) -> None:
        self.a, self.b = a, b
        self.rows, self.spans = rows, spans

    @classmethod
    def of(cls, a: Array, b: Array) -> PointPair:
        """Return the pair of points (N, 2) and (N, 2)."""
        xa, ya, xb, yb = a[:, 0], a[:, 1], b[:, 0], b[:, 1]
        rows = np.stack([yb * xa, -yb, -ya * xb, ya])
        spans = np.stack([xa * xa + yb * yb, xa, np.ones(len(a)), xb * xb + ya * ya, xb])
        return cls(a, b, rows, spans)

    def __len__(self) -> int:
        return len(self.a)

    def at(self, inside: Mask) -> PointPair:
        """Return some of the features."""
        if inside.all():
            return self
        return PointPair(
            self.a[inside], self.b[inside], self.rows[:, inside], self.spans[:, inside]
        )

    def noise(self, m: Array) -> Array:
        """Return the variance (H, N) of the rows times m (H, 4), in σ²."""
        products = (m[:, _FIRST] * m[:, _SECOND]) @ _SUMMED
        return np.asarray(np.maximum(products @ self.spans, 1e-18))

    def squared(self, m: Array) -> Array:
        """Return squared Sampson residuals (H, N) for hypotheses m (H, 4)."""
        return np.asarray((m @ self.rows) ** 2 / self.noise(m))

    def residuals(self, m: Array) -> tuple[Array, Array]:
        """Return Sampson residuals (..., N) for m (..., 4), and their derivatives (..., 4, N)."""
        spread = (m @ _SPREAD).reshape(*m.shape, 5) @ self.spans
        variance = np.maximum((m[..., None, :] @ spread)[..., 0, :], 1e-18)
        scale = 1.0 / np.sqrt(variance)
        error = m @ self.rows
        jacobian = self.rows - (error / variance)[..., None, :] * spread
        return error * scale, jacobian * scale[..., None, :]
