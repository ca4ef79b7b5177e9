"""Robust refinement of trifocal tensors on bearing residuals, with covariance.

The refinement works in the coordinates z of a linear family T = basis·z (see
`trifocal_solvers`), on the unit sphere: T is projective, so is z. With a known initial view,
z = (cos φ2, sin φ2, t_x2, t_y2) up to scale, and its three degrees of freedom are the pose.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.robust.least_squares import Options, Solved, gauss_newton
from visctrl.geometry.robust.scale import upper_mad_sd
from visctrl.geometry.robust.symmetric import inverse4
from visctrl.geometry.trifocal.tensor import (
    Linearised,
    Trilinear,
    initial_view_basis,
    linearised,
)

Array = NDArray[np.float64]

#: Width of the kernel in spreads of the residuals.
WIDTH = 4.0
#: Steps are at most so many times those of the weighted least squares.
PACE = 1.5
#: What keeps a singular matrix invertible, as a share of its size.
TINY = 1e-12
#: At least this share of a direction's information is taken for real.
_LEAST_SHARE = 0.03
#: A step of 0.02 standard deviations of the result ends the iteration; the longest one is on the
#: unit sphere.
_OPTIONS = Options(iterations=20, converged=0.02**2, longest=0.3)


class TensorFit(NamedTuple):
    """Refined coordinates of a tensor.

    z : (k,) of unit length.
    covariance : (k, k), first order; singular along z.
    information : (k, k), its inverse across z.
    linear : residuals (N,) in rad and what they depend on.
    jacobian : (k, N), their derivatives by z.
    weights : (N,) of the last iteration, in 0…1.
    spread : robust standard deviation of the residuals (rad), at least the promised one.

    All but z and the residuals are those before the last step, which is too short to matter.
    """

    z: Array
    covariance: Array
    information: Array
    linear: Linearised
    jacobian: Array
    weights: Array
    spread: float

    @property
    def residuals(self) -> Array:
        """Sampson residuals (N,) in rad."""
        return self.linear.residual


def refine(relation: Trilinear, start: Array, sigma: float) -> TensorFit:
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
    """
    z, at, step, _ = gauss_newton(
        lambda z: _weighted(relation, z, sigma),
        _solve,
        _on_sphere,
        start / math.sqrt(start.dot(start)),
        _OPTIONS,
    )
    variance = at.spread**2
    return TensorFit(
        z,
        variance * at.inverse,
        at.information / variance,
        Linearised(at.linear.residual + step.dot(at.jacobian), at.linear.slopes),
        at.jacobian,
        at.weights,
        at.spread,
    )


class _Weighted(NamedTuple):
    """Residuals at one z and their weights, the information (k, k) and its inverse across z.

    gradient : (k,) of the cost. pace : how much longer Newton's step is than the weights' own.
    """

    linear: Linearised
    jacobian: Array
    weights: Array
    spread: float
    information: Array
    inverse: Array
    gradient: Array
    pace: float


def _weighted(relation: Trilinear, z: Array, sigma: float) -> _Weighted:
    linear = linearised(relation, z)
    residual, jacobian = linear.residual, linear.jacobian(relation)
    spread = max(sigma, upper_mad_sd(residual))
    weights, pace = _geman_mcclure(residual, spread)
    weighted = jacobian * weights
    information = weighted.dot(jacobian.T)
    inverse, gradient = _inverse_across(information, z), weighted.dot(residual)
    return _Weighted(linear, jacobian, weights, spread, information, inverse, gradient, pace)


def _solve(at: _Weighted) -> Solved[Array]:
    step = at.inverse.dot(at.gradient)
    step *= -at.pace
    gain = float(at.information.dot(step).dot(step)) / at.spread**2
    return Solved(step, gain, math.sqrt(step.dot(step)))


def _on_sphere(z: Array, step: Array) -> Array:
    moved = z + step
    moved /= math.sqrt(moved.dot(moved))
    return moved


def debiased_covariance(relation: Trilinear, fit: TensorFit, sigma: float) -> Array:
    """Return the covariance (k, k) of a fit without what noise alone adds to its information.

    With a short baseline the residuals' derivatives are mostly noise themselves, which looks
    like information: the first-order covariance is then several times too small. The expected
    share of the noise is taken out, D = Σ w (j jᵀ − N), and the estimate's covariance is
    D⁻¹ I D⁻¹ with the information I as it came.
    """
    noise = _noise(relation, fit.z, fit.weights * (sigma / fit.spread) ** 2)
    values, vectors = np.linalg.eigh(_across(fit.information - noise, fit.z))
    raw = np.einsum("ik,ij,jk->k", vectors, fit.information, vectors)
    values = np.maximum(values, _LEAST_SHARE * raw)
    # The smallest is the direction of z, which the residuals do not depend on.
    order = np.argsort(np.abs(vectors.T @ fit.z))[:-1]
    inverse = (vectors[:, order] / np.maximum(values[order], 1e-300)) @ vectors[:, order].T
    return np.asarray(inverse @ fit.information @ inverse)


def _noise(relation: Trilinear, z: Array, rows: Array) -> Array:
    """Return Σ rows_n N_n (k, k), N_n the noise in residual n's derivatives per squared radian."""
    slopes = relation.gradient @ z
    square = np.maximum(np.sum(slopes**2, axis=0), 1e-24)
    # The residual is one combination of the three directions, and known: it is taken out.
    known = np.sum(slopes[..., None] * relation.gradient, axis=0)
    noise = np.einsum("n,vni,vnj->ij", rows / square, relation.gradient, relation.gradient)
    return np.asarray(noise - np.einsum("n,ni,nj->ij", rows / square**2, known, known))


def view_of(z: Array) -> tuple[float, tuple[float, float]]:
    """Return the heading (rad) and target (right, forward) that view coordinates z (4,) stand for.

    The unit is that of the other view. z and −z are the same tensor; the sign must be right.
    """
    cosine, sine, right, forward = z.tolist()
    norm = math.hypot(cosine, sine)
    if norm == 0.0:
        return math.atan2(sine, cosine), (math.inf, math.inf)
    return math.atan2(sine, cosine), (right / norm, forward / norm)


def view_jacobian(z: Array) -> Array:
    """Return the derivative (3, 4) of (φ, t_x, t_y) by z (see `view_of`)."""
    cosine, sine, right, forward = z.tolist()
    square = cosine**2 + sine**2
    norm = math.sqrt(square)
    x, y = right / (square * norm), forward / (square * norm)
    return np.array(
        [
            [-sine / square, cosine / square, 0.0, 0.0],
            [-x * cosine, -x * sine, 1.0 / norm, 0.0],
            [-y * cosine, -y * sine, 0.0, 1.0 / norm],
        ]
    )


class Coupling(NamedTuple):
    """What a fit says about the initial view p1(q) that it takes for granted, to first order.

    by_initial : (8, m), dT/dq with the current view as fitted.
    sensitivity : (4, m), dz/dq of the fit.
    information : (m, m), of q, the current view being unknown.
    gradient : (m,), so that q + information⁻¹ gradient fits the features best.
    """

    by_initial: Array
    sensitivity: Array
    information: Array
    gradient: Array


def coupling(
    relation: Trilinear, fit: TensorFit, view_1: Array, view_1_jacobian: Array
) -> Coupling:
    """Return the coupling of a fit to its initial view.

    Parameters
    ----------
    relation : Trilinear
        Of the features, in the tensor's own coordinates (k = 8).
    fit : TensorFit
        Made within ``current_view_basis(view_1)``.
    view_1, view_1_jacobian : (4,), (4, m) arrays
        The initial view's parameters, and their derivatives by q.
    """
    by_initial = initial_view_basis(fit.z).dot(view_1_jacobian)
    by_q = fit.linear.jacobian(relation.within(by_initial))
    weighted = (by_q * (fit.weights / fit.spread**2)).T
    mixed = fit.jacobian.dot(weighted)
    shift = -fit.covariance.dot(mixed)
    information = by_q.dot(weighted) + mixed.T.dot(shift)
    return Coupling(by_initial, shift, information, -weighted.T.dot(fit.residuals))


def _geman_mcclure(residual: Array, spread: float) -> tuple[Array, float]:
    """Return the kernel's weights, and how much longer than theirs Newton's step is."""
    scaled = residual * (1.0 / (WIDTH * spread))
    root = 1.0 / (1.0 + scaled * scaled)
    weights = root * root
    total = float(root.dot(root))
    # The second derivative of the cost is weights (4 root − 3) where that of the weights' own
    # least squares is weights; where residuals are as promised, the mean will do.
    curvature = 4.0 * float(weights.dot(root)) - 3.0 * total
    return weights, min(PACE, total / curvature) if curvature > 0.0 else PACE


def _across(matrix: Array, z: Array) -> Array:
    """Return a symmetric matrix restricted to what is at right angles to z."""
    across = np.eye(len(z)) - np.outer(z, z)
    return np.asarray(across @ matrix @ across)


def _inverse_across(information: Array, z: Array) -> Array:
    """Return the pseudo-inverse of ``information``, whose null direction is z."""
    along = z[:, None] * z
    size = float(information.trace()) + 1e-300
    completed = information + size * (along + _tiny_identity(len(z)))
    inverse = inverse4(completed) if len(z) == 4 else np.linalg.inv(completed)
    return np.asarray(inverse - along / size)


@cache
def _tiny_identity(size: int) -> Array:
    return TINY * np.eye(size)
