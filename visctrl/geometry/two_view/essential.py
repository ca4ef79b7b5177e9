"""Epipolar geometry of two views in general motion: fundamental and essential matrices.

Both are written as aᵀ M b = 0 for the same point seen as ``a`` and ``b``. The essential matrix
takes unit rays of any central camera, those past 90° included; the fundamental matrix takes image
points of a perspective camera, with nothing known of its calibration. The epipoles are the null
vectors: M e_b = 0, Mᵀ e_a = 0. Hartley & Zisserman, Multiple View Geometry, ch. 11.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: Correspondences that the linear solution needs.
MINIMUM_FEATURES = 8


class Epipole(NamedTuple):
    """An epipole as a unit vector of its view, and the covariance of that vector (3, 3)."""

    direction: Array
    covariance: Array

    @property
    def bearing(self) -> float:
        """Bearing (rad, clockwise from forward) for rays as (right, forward, up)."""
        return math.atan2(self.direction[0], self.direction[1])

    @property
    def bearing_sd(self) -> float:
        """First-order standard deviation of the bearing (rad)."""
        right, forward, _ = self.direction
        level2 = max(float(right**2 + forward**2), 1e-300)
        gradient = np.array([forward, -right, 0.0]) / level2
        return math.sqrt(max(float(gradient @ self.covariance @ gradient), 0.0))


def constraint_rows(a: ArrayLike, b: ArrayLike) -> Array:
    """Return the rows (..., N, 9) of the linear system in M's elements, row by row of M."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    outer = a[..., :, None] * b[..., None, :]
    return np.asarray(outer.reshape(*outer.shape[:-2], 9))


def null_matrices(rows: ArrayLike) -> Array:
    """Return the unit matrices (..., 3, 3) that fit rows (..., N, 9), N ≥ 8, best."""
    rows = np.asarray(rows, dtype=np.float64)
    if rows.shape[-2] == MINIMUM_FEATURES:
        vector = np.linalg.svd(rows)[2][..., -1, :]
    else:
        vector = np.linalg.eigh(np.swapaxes(rows, -1, -2) @ rows)[1][..., :, 0]
    return np.asarray(vector.reshape(*vector.shape[:-1], 3, 3))


def singular(M: ArrayLike) -> Array:
    """Return the nearest matrices (..., 3, 3) of rank two."""
    U, s, Vt = np.linalg.svd(np.asarray(M, dtype=np.float64))
    s[..., 2] = 0.0
    return np.asarray((U * s[..., None, :]) @ Vt)


def essential(M: ArrayLike) -> Array:
    """Return the nearest matrices (..., 3, 3) with singular values (1, 1, 0)."""
    U, _, Vt = np.linalg.svd(np.asarray(M, dtype=np.float64))
    return np.asarray((U * np.array([1.0, 1.0, 0.0])) @ Vt)


def singular_tangent(M: ArrayLike) -> Array:
    """Return an orthonormal basis (7, 9) of the changes of M (3, 3) that keep rank and norm."""
    M = np.asarray(M, dtype=np.float64)
    U, _, Vt = np.linalg.svd(M)
    fixed = np.stack([np.outer(U[:, 2], Vt[2]).ravel(), M.ravel()])
    return np.asarray(np.linalg.svd(fixed)[2][2:])


def essential_tangent(M: ArrayLike) -> Array:
    """Return an orthonormal basis (5, 9) of the changes of M (3, 3) that keep it essential."""
    U, _, Vt = np.linalg.svd(np.asarray(M, dtype=np.float64))
    D = np.diag([1.0, 1.0, 0.0])
    turns = np.zeros((3, 3, 3))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        turns[k, i, j], turns[k, j, i] = -1.0, 1.0
    changes = np.concatenate([U @ turns @ D @ Vt, U @ D @ turns @ Vt]).reshape(6, 9)
    return np.asarray(np.linalg.svd(changes)[2][:5])


def conditioning(points: ArrayLike) -> Array:
    """Return T (3, 3): T x has its centroid at the origin and a mean distance of √2 from it.

    ``points`` are (N, 3) homogeneous with last element 1. The 8-point solution on raw pixels is
    useless without it (Hartley 1997).
    """
    x = np.asarray(points, dtype=np.float64)[:, :2]
    centre = x.mean(axis=0)
    distance = float(np.linalg.norm(x - centre, axis=1).mean())
    scale = math.sqrt(2.0) / max(distance, 1e-12)
    return np.array(
        [[scale, 0.0, -scale * centre[0]], [0.0, scale, -scale * centre[1]], [0.0, 0.0, 1.0]]
    )


def sampson_scale(M: ArrayLike, a: Array, b: Array, *, planar_image: bool) -> tuple[Array, Array]:
    """Return the algebraic errors (..., N) of M (..., 3, 3), and the norms of their gradients.

    Parameters
    ----------
    M : (..., 3, 3) array
    a, b : (N, 3) arrays
        Unit rays, or homogeneous image points with last element 1.
    planar_image : bool
        Whether only the first two elements are measured (image points) or all three (rays).
    """
    M = np.asarray(M, dtype=np.float64)
    by_a = b @ np.swapaxes(M, -1, -2)
    by_b = a @ M
    error = np.sum(by_a * a, axis=-1)
    measured = 2 if planar_image else 3
    squared = np.sum(by_a[..., :measured] ** 2, axis=-1) + np.sum(
        by_b[..., :measured] ** 2, axis=-1
    )
    return error, np.sqrt(np.maximum(squared, 1e-300))


def sampson_residuals(
    M: ArrayLike, a: Array, b: Array, *, planar_image: bool
) -> tuple[Array, Array]:
    """Return the Sampson residuals (N,) of M (3, 3), and ∂/∂M's elements (N, 9).

    Arguments as for `sampson_scale`. To first order a residual has the standard deviation of one
    measured coordinate.
    """
    M = np.asarray(M, dtype=np.float64)
    error, scale = sampson_scale(M, a, b, planar_image=planar_image)
    by_a, by_b = b @ M.T, a @ M
    if planar_image:
        by_a[:, 2] = by_b[:, 2] = 0.0
    residual = error / scale
    change = constraint_rows(by_a, b) + constraint_rows(a, by_b)
    jacobian = constraint_rows(a, b) - (residual / scale)[:, None] * change
    return residual, np.asarray(jacobian / scale[:, None])


def epipoles(M: ArrayLike, covariance: ArrayLike) -> tuple[Epipole, Epipole]:
    """Return the epipoles in views a and b of a matrix M (3, 3) and their covariances.

    Parameters
    ----------
    M : (3, 3) array
        Essential or fundamental matrix.
    covariance : (9, 9) array
        Of M's elements, row by row.

    A null vector n of M moves by −M⁺ δM n to first order.
    """
    M = np.asarray(M, dtype=np.float64)
    cov = np.asarray(covariance, dtype=np.float64)
    U, s, Vt = np.linalg.svd(M)
    inverse = np.divide(1.0, s, out=np.zeros(3), where=np.arange(3) < 2)
    e_a, e_b = U[:, 2], Vt[2]
    # δM n as a linear map of δM's nine elements, for M's own rows and for its columns.
    right = np.kron(np.eye(3), e_b[None, :])
    left = np.kron(e_a[None, :], np.eye(3))
    J_b = -(Vt.T * inverse) @ U.T @ right
    J_a = -(U * inverse) @ Vt @ left
    return Epipole(e_a, J_a @ cov @ J_a.T), Epipole(e_b, J_b @ cov @ J_b.T)
