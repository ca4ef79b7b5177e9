"""Minimal solver: planar motion from the image points of three features, calibration left open.

With the baseline along the bearings θ_a and θ_b of the two views,

    y_b (x_a c_a − s_a) − y_a (x_b c_b − s_b) = 0,   tan θ = s/c,

is linear in m = (c_a, s_a, c_b, s_b); see `planar_free`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def constraint_rows(points_a: ArrayLike, points_b: ArrayLike) -> Array:
    """Return the coefficients (..., 4) of m in the constraint of points (..., 2)."""
    a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    xa, ya, xb, yb = a[..., 0], a[..., 1], b[..., 0], b[..., 1]
    return np.stack([yb * xa, -yb, -ya * xb, ya], axis=-1)


def null_vectors(rows: ArrayLike) -> Array:
    """Return the unit vectors (..., 4) orthogonal to the three rows of (..., 3, 4) matrices."""
    M = np.asarray(rows, dtype=np.float64)
    p, q, r = M[..., 0, :], M[..., 1, :], M[..., 2, :]
    # 2×2 minors of the last two rows, then expansion along the first: a cross product in 4D.
    minor = {
        (i, j): q[..., i] * r[..., j] - q[..., j] * r[..., i] for i in range(4) for j in range(i)
    }

    def cofactor(i: int, j: int, k: int) -> Array:
        return np.asarray(
            p[..., i] * minor[k, j] - p[..., j] * minor[k, i] + p[..., k] * minor[j, i]
        )

    m = np.stack([cofactor(1, 2, 3), -cofactor(0, 2, 3), cofactor(0, 1, 3), -cofactor(0, 1, 2)], -1)
    length = np.linalg.norm(m, axis=-1, keepdims=True)
    # Dependent rows (repeated features, identical views) have no null vector of their own.
    usual = np.sqrt(0.5) * np.array([1.0, 0.0, 1.0, 0.0])
    return np.asarray(np.where(length > 1e-300, m / np.maximum(length, 1e-300), usual))
