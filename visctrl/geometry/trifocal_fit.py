"""Robust refinement of trifocal tensors on bearing residuals, with covariance.

The refinement works in the coordinates z of a linear family T = basis·z (see
`trifocal_solvers`), on the unit sphere: T is projective, so is z. With a known initial view,
z = (cos φ2, sin φ2, t_x2, t_y2) up to scale, and its three degrees of freedom are the pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.trifocal import (
    Trilinear,
    current_view_basis,
    initial_view_basis,
    sampson_jacobian,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Width of the kernel in spreads of the residuals.
_WIDTH = 4.0
#: Longest step on the unit sphere.
_LONGEST_STEP = 0.3
#: A step this short, in standard deviations of the result, ends the iteration.
_CONVERGED = 0.02


@dataclass(frozen=True)
class Fit:
    """Refined coordinates of a tensor.

    z : (k,) of unit length.
    covariance : (k, k), first order; singular along z.
    information : (k, k), its inverse across z.
    residuals : (N,) in rad.
    weights : (N,) of the last iteration, in 0…1.
    spread : robust standard deviation of the residuals (rad), at least the promised one.
    inliers : (N,) features within three spreads.
    """

    z: Array
    covariance: Array
    information: Array
    residuals: Array
    weights: Array
    spread: float
    inliers: Mask


def refine(relation: Trilinear, start: Array, sigma: float, *, iterations: int = 20) -> Fit:
    """Refine coordinates by robust Gauss–Newton on Sampson residuals.

    The kernel (Geman–McClure) is redescending: gross errors of high leverage would pull any
    other away. Its width follows the spread of the residuals, wide at a poor start and narrow
    in the end, never ``sigma`` alone: narrower than the tracks' drift, it would lock on to
    whichever few features happen to agree.

    Parameters
    ----------
    relation : Trilinear
        Of N features, in the coordinates to refine.
    start : (k,) array
        Where to start; any length.
    sigma : float
        Standard deviation of one direction (rad).
    iterations : int
        At most this many steps.
    """
    z = start / np.linalg.norm(start)
    for _ in range(iterations):
        residual, jacobian = sampson_jacobian(relation, z)
        spread = _spread(residual, sigma)
        step, length = _step(jacobian, residual, _geman_mcclure(residual / spread), z)
        z = z + step
        z /= np.linalg.norm(z)
        if length < _CONVERGED * spread:
            break
    residual, jacobian = sampson_jacobian(relation, z)
    spread = _spread(residual, sigma)
    weights = _geman_mcclure(residual / spread)
    information = (weights[:, None] * jacobian).T @ jacobian / spread**2
    return Fit(
        z,
        _tangent_inverse(information, z),
        information,
        residual,
        weights,
        spread,
        np.abs(residual) < 3.0 * spread,
    )


def view_of(z: Array) -> tuple[float, Array]:
    """Return the heading (rad) and target position (2,) that view coordinates z (4,) stand for.

    The unit is that of the other view. z and −z are the same tensor; the sign must be right.
    """
    return float(np.arctan2(z[1], z[0])), np.asarray(z[2:] / np.hypot(z[0], z[1]))


def view_jacobian(z: Array) -> Array:
    """Return the derivative (3, 4) of (φ, t_x, t_y) by z (see `view_of`)."""
    square = z[0] ** 2 + z[1] ** 2
    norm = np.sqrt(square)
    J = np.zeros((3, 4))
    J[0, :2] = -z[1] / square, z[0] / square
    J[1:, :2] = -np.outer(z[2:], z[:2]) / (square * norm)
    J[1, 2] = J[2, 3] = 1.0 / norm
    return J


class Coupling(NamedTuple):
    """What a fit says about the initial view p1(q) that it takes for granted, to first order.

    sensitivity : (4, m), dz/dq of the fit.
    information : (m, m), of q, the current view being unknown.
    gradient : (m,), so that q + information⁻¹ gradient fits the features best.
    """

    sensitivity: Array
    information: Array
    gradient: Array


def coupling(relation: Trilinear, fit: Fit, view_1: Array, view_1_jacobian: Array) -> Coupling:
    """Return the coupling of a fit to its initial view.

    Parameters
    ----------
    relation : Trilinear
        Of the features, in the tensor's own coordinates (k = 8).
    fit : Fit
        Made within ``current_view_basis(view_1)``.
    view_1, view_1_jacobian : (4,), (4, m) arrays
        The initial view's parameters, and their derivatives by q.
    """
    basis = current_view_basis(view_1)
    _, by_tensor = sampson_jacobian(relation, basis @ fit.z)
    by_z = by_tensor @ basis
    by_q = by_tensor @ initial_view_basis(fit.z) @ view_1_jacobian
    weighted = (fit.weights / fit.spread**2)[:, None] * by_q
    mixed = by_z.T @ weighted
    shift = -fit.covariance @ mixed
    return Coupling(shift, by_q.T @ weighted + mixed.T @ shift, -weighted.T @ fit.residuals)


def _geman_mcclure(scaled: Array) -> Array:
    return np.asarray(1.0 / (1.0 + (scaled / _WIDTH) ** 2) ** 2)


def _spread(residual: Array, sigma: float) -> float:
    """Return the robust standard deviation of the residuals, at least ``sigma``."""
    middle = len(residual) // 2
    return max(sigma, 1.4826 * float(np.partition(np.abs(residual), middle)[middle]))


def _step(jacobian: Array, residual: Array, weights: Array, z: Array) -> tuple[Array, float]:
    """Return the Gauss–Newton step (k,) across z, bounded, and its length in residuals (rad)."""
    weighted = weights[:, None] * jacobian
    H = weighted.T @ jacobian
    step = np.asarray(-np.linalg.solve(_completed(H, z), weighted.T @ residual), dtype=np.float64)
    step *= min(1.0, _LONGEST_STEP / max(float(np.linalg.norm(step)), 1e-300))
    return step, math.sqrt(max(float(step @ H @ step), 0.0))


def _completed(information: Array, z: Array) -> Array:
    """Return ``information`` made invertible along z, on which the residuals do not depend."""
    size = float(np.trace(information)) + 1e-300
    return np.asarray(information + size * (np.outer(z, z) + 1e-12 * np.eye(len(z))))


def _tangent_inverse(information: Array, z: Array) -> Array:
    """Return the inverse of ``information`` across z (its null direction)."""
    across = np.eye(len(z)) - np.outer(z, z)
    return np.asarray(across @ np.linalg.inv(_completed(information, z)) @ across)
