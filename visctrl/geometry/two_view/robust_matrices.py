"""Robust essential and fundamental matrices: batched hypotheses, then a refined best one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from visctrl.contracts import Health
from visctrl.geometry.two_view.essential import (
    MINIMUM_FEATURES,
    Epipole,
    conditioning,
    constraint_rows,
    epipoles,
    essential,
    essential_tangent,
    null_matrices,
    sampson_residuals,
    sampson_scale,
    singular,
    singular_tangent,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Hypotheses solved and scored in one array operation.
_BATCH = 256
#: Hypotheses of a batch that are refined on their inliers.
_FINALISTS = 4
_REFINEMENTS = 5
#: Gauss–Newton steps on the best matrix, and the longest of them (of a unit matrix).
_DESCENTS, _LONGEST_STEP = 10, 0.2
#: Probability of having drawn one clean sample after which the search ends.
_CONFIDENCE = 0.999
#: Scale of the soft-L1 kernel in standard deviations of the residual.
_KERNEL_SIGMAS = 1.5
#: A second solution is ruled out by this many standard deviations of the noise's share.
_SIGNIFICANCE = 5.0
#: Standard deviation of an epipole (rad) beyond which it counts as undetermined.
_MAX_SD = 0.5
#: Least share of the widest spread that features must have across it.
_MIN_SPREAD_SIGMAS = 30.0


class Degeneracy(StrEnum):
    """Why the matrix or its epipoles are not determined."""

    NONE = ""
    TOO_FEW = "too few features"
    NO_AGREEMENT = "no agreement: too few features fit one motion"
    CLUSTERED = "clustered features: they do not spread over the image"
    MANY_SOLUTIONS = "planar scene or identical views: many matrices fit"
    SHORT_BASELINE = "short baseline: the direction of the epipoles is not determined"


@dataclass(frozen=True)
class EpipolarGeometry:
    """An essential or fundamental matrix with what is known of it.

    matrix : (3, 3), aᵀ M b = 0, of unit Frobenius norm; zero where nothing was found.
    epipole_a, epipole_b : b's centre seen in a, and a's centre seen in b, up to sign.
    inliers : (N,) correspondences that agree with it.
    degeneracy : what is not determined, if anything; `health` follows from it.
    """

    matrix: Array
    epipole_a: Epipole
    epipole_b: Epipole
    inliers: Mask
    degeneracy: Degeneracy

    @property
    def health(self) -> Health:
        """``LOST`` without a matrix, ``DEGENERATE`` with one that is not determined."""
        if self.degeneracy is Degeneracy.NONE:
            return Health.OK
        lost = self.degeneracy in (Degeneracy.TOO_FEW, Degeneracy.NO_AGREEMENT)
        return Health.LOST if lost else Health.DEGENERATE


@dataclass(frozen=True)
class _Problem:
    """Correspondences in the coordinates in which the matrix is solved."""

    a: Array
    b: Array
    sigma: float
    planar_image: bool
    project: Callable[[ArrayLike], Array]
    tangent: Callable[[ArrayLike], Array]

    def sampson(self, M: Array) -> tuple[Array, Array]:
        """Return algebraic errors (..., N) and the norms of their gradients."""
        return sampson_scale(M, self.a, self.b, planar_image=self.planar_image)

    def kernel(self, squared: Array) -> Array:
        """Return the square roots of the soft-L1 weights of squared residuals."""
        return np.asarray((1.0 + squared / (_KERNEL_SIGMAS * self.sigma) ** 2) ** -0.25)

    def squared(self, M: Array) -> Array:
        """Return squared Sampson residuals (..., N)."""
        error, scale = self.sampson(M)
        return np.asarray((error / scale) ** 2)


def robust_essential(
    rays_a: ArrayLike,
    rays_b: ArrayLike,
    sigma: float,
    *,
    seed: int = 0,
    threshold_sigmas: float = 2.5,
    max_hypotheses: int = 4096,
) -> EpipolarGeometry:
    """Find the essential matrix of unit rays (N, 3) of any central camera.

    Parameters
    ----------
    rays_a, rays_b : (N, 3) arrays
        Unit rays of the same features in both views, in any direction.
    sigma : float
        Standard deviation of one ray's direction (rad).
    seed : int
        Of the random samples; the same seed gives the same result.
    threshold_sigmas : float
        Residual (in ``sigma``) beyond which a correspondence counts as an outlier.
    max_hypotheses : int
        The search ends earlier once it is certain enough.
    """
    a, b = np.asarray(rays_a, dtype=np.float64), np.asarray(rays_b, dtype=np.float64)
    problem = _Problem(a, b, sigma, False, essential, essential_tangent)
    return _search(problem, threshold_sigmas, max_hypotheses, seed)


def robust_fundamental(
    points_a: ArrayLike,
    points_b: ArrayLike,
    sigma: float,
    *,
    seed: int = 0,
    threshold_sigmas: float = 2.5,
    max_hypotheses: int = 4096,
) -> EpipolarGeometry:
    """Find the fundamental matrix of image points (N, 2) of a perspective camera.

    Parameters
    ----------
    points_a, points_b : (N, 2) arrays
        Pixels, or any linear function of them; the matrix is in the same units.
    sigma : float
        Standard deviation of one coordinate.
    seed, threshold_sigmas, max_hypotheses
        As for `robust_essential`.
    """
    a, b = (_homogeneous(points) for points in (points_a, points_b))
    if len(a) < MINIMUM_FEATURES:
        return _nothing(len(a), Degeneracy.TOO_FEW)
    T_a, T_b = conditioning(a), conditioning(b)
    # One noise level for both: the geometric mean of the two scalings.
    scaled = sigma * float(np.sqrt(T_a[0, 0] * T_b[0, 0]))
    problem = _Problem(a @ T_a.T, b @ T_b.T, scaled, True, singular, singular_tangent)
    found = _search(problem, threshold_sigmas, max_hypotheses, seed)
    if found.health is Health.LOST:
        return found
    matrix = T_a.T @ found.matrix @ T_b
    return EpipolarGeometry(
        matrix / np.linalg.norm(matrix),
        _transformed(found.epipole_a, np.asarray(np.linalg.inv(T_a), dtype=np.float64)),
        _transformed(found.epipole_b, np.asarray(np.linalg.inv(T_b), dtype=np.float64)),
        found.inliers,
        found.degeneracy,
    )


def _search(
    problem: _Problem, threshold_sigmas: float, max_hypotheses: int, seed: int
) -> EpipolarGeometry:
    count = len(problem.a)
    if count < MINIMUM_FEATURES:
        return _nothing(count, Degeneracy.TOO_FEW)
    rng = np.random.default_rng(seed)
    rows = constraint_rows(problem.a, problem.b)
    limit2 = (threshold_sigmas * problem.sigma) ** 2
    best, best_cost, drawn = np.zeros((3, 3)), np.inf, 0
    while drawn < max_hypotheses:
        samples = rng.random((_BATCH, count)).argpartition(MINIMUM_FEATURES - 1, axis=1)
        M = null_matrices(rows[samples[:, :MINIMUM_FEATURES]])
        drawn += _BATCH
        cost = np.minimum(problem.squared(M), limit2).sum(axis=-1)
        for index in np.argsort(cost)[:_FINALISTS]:
            refined = _refined(problem, rows, M[index], limit2)
            refined_cost = float(np.minimum(problem.squared(refined), limit2).sum())
            if refined_cost < best_cost:
                best, best_cost = refined, refined_cost
        share = float((problem.squared(best) < limit2).mean())
        if (1.0 - share**MINIMUM_FEATURES) ** drawn < 1.0 - _CONFIDENCE:
            break
    return _judge(problem, rows, best, limit2)


def _refined(problem: _Problem, rows: Array, M: Array, limit2: float) -> Array:
    """Return M re-estimated linearly on its inliers, weighted by Sampson's scale."""
    for _ in range(_REFINEMENTS):
        weighted = _weighted_rows(problem, rows, M, limit2)
        if weighted is None:
            break
        M = singular(null_matrices(weighted))
    return M


def _weighted_rows(problem: _Problem, rows: Array, M: Array, limit2: float) -> Array | None:
    """Return the inliers' rows of unit noise (in ``sigma``), or None if they are too few."""
    weights = _weights(problem, M, limit2)
    inside = weights > 0.0
    if int(inside.sum()) <= MINIMUM_FEATURES:
        return None
    return np.asarray(rows[inside] * weights[inside, None])


def _weights(problem: _Problem, M: Array, limit2: float) -> Array:
    """Return the weight (N,) of each row: soft-L1 over Sampson's scale, 0 for an outlier."""
    error, scale = problem.sampson(M)
    squared = (error / scale) ** 2
    return np.where(squared < limit2, problem.kernel(squared) / scale, 0.0)


def _descend(problem: _Problem, start: Array, limit2: float) -> Array:
    """Return the matrix after Gauss–Newton steps that keep it essential or singular.

    The linear solution is biased where the noise moves Sampson's scale itself; this one is not.
    """
    M = problem.project(start)
    M = M / np.linalg.norm(M)
    for _ in range(_DESCENTS):
        residual, jacobian = sampson_residuals(
            M, problem.a, problem.b, planar_image=problem.planar_image
        )
        tangent = problem.tangent(M)
        weights = np.where(residual**2 < limit2, problem.kernel(residual**2), 0.0)
        J = (weights[:, None] * jacobian) @ tangent.T
        information = J.T @ J
        damping = 1e-9 * max(float(information.trace()), 1e-300) * np.eye(len(tangent))
        step = np.linalg.solve(information + damping, -J.T @ (weights * residual))
        step *= min(1.0, _LONGEST_STEP / max(float(np.linalg.norm(step)), 1e-300))
        M = problem.project(M + (step @ tangent).reshape(3, 3))
        M = M / np.linalg.norm(M)
    return np.asarray(M)


def _judge(problem: _Problem, rows: Array, start: Array, limit2: float) -> EpipolarGeometry:
    """Return the refined matrix, its epipoles, and the name of what is not determined."""
    M = _descend(problem, start, limit2)
    weights = _weights(problem, M, limit2)
    inliers = np.asarray(weights > 0.0)
    if int(inliers.sum()) <= MINIMUM_FEATURES:
        return _nothing(len(rows), Degeneracy.NO_AGREEMENT)
    weighted = rows * weights[:, None]
    tangent = problem.tangent(M)
    axes, signal, needed = _information(problem, weights, weighted, tangent)
    known = np.maximum(signal, 1e-12 * signal[-1])
    covariance = (axes.T * (problem.sigma**2 / known)) @ axes
    epipole_a, epipole_b = epipoles(M, covariance)
    widest = max(epipole_a.covariance.trace(), epipole_b.covariance.trace())
    degeneracy = Degeneracy.NONE
    if _clustered(problem, inliers):
        degeneracy = Degeneracy.CLUSTERED
    elif _many_solutions(problem, weights, weighted):
        degeneracy = Degeneracy.MANY_SOLUTIONS
    elif signal[0] < needed[0] or widest > _MAX_SD**2:
        degeneracy = Degeneracy.SHORT_BASELINE
    return EpipolarGeometry(M, epipole_a, epipole_b, inliers, degeneracy)


def _many_solutions(problem: _Problem, weights: Array, weighted: Array) -> bool:
    """Return whether the linear system has a second solution within the noise."""
    _, signal, needed = _information(problem, weights, weighted, np.eye(9))
    return bool(signal[1] < needed[1])


def _information(
    problem: _Problem, weights: Array, weighted: Array, basis: Array
) -> tuple[Array, Array, Array]:
    """Return what the features tell of M within the span of ``basis`` (k, 9).

    Returns
    -------
    axes : (k, 9) array
        Principal directions, the least known first.
    signal : (k,) array
        Information along each (of unit noise), less what noise alone would put there.
    needed : (k,) array
        What it must exceed to be more than a chance result of that noise.
    """
    J = weighted @ basis.T
    values, vectors = np.linalg.eigh(J.T @ J)
    axes = vectors.T @ basis
    _, scales = problem.sampson(axes.reshape(-1, 3, 3))
    noise = (problem.sigma * scales * weights) ** 2
    needed = _SIGNIFICANCE * np.sqrt(2.0 * (noise**2).sum(axis=1))
    return axes, values - noise.sum(axis=1), needed


def _clustered(problem: _Problem, inliers: Mask) -> bool:
    """Return whether the inliers hardly spread in some direction of either view."""
    for view in (problem.a[inliers], problem.b[inliers]):
        spread = np.linalg.svd(view - view.mean(axis=0), compute_uv=False)[1]
        if spread / np.sqrt(len(view)) < _MIN_SPREAD_SIGMAS * problem.sigma:
            return True
    return False


def _homogeneous(points: ArrayLike) -> Array:
    points = np.asarray(points, dtype=np.float64)
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


def _transformed(epipole: Epipole, T: Array) -> Epipole:
    """Return an epipole, a homogeneous vector, in coordinates x' = T x."""
    vector = T @ epipole.direction
    length = float(np.linalg.norm(vector))
    unit = vector / length
    J = (np.eye(3) - np.outer(unit, unit)) @ T / length
    return Epipole(unit, J @ epipole.covariance @ J.T)


def _nothing(count: int, degeneracy: Degeneracy) -> EpipolarGeometry:
    unknown = Epipole(np.array([0.0, 1.0, 0.0]), np.diag([np.inf, 0.0, np.inf]))
    none = np.zeros(count, dtype=np.bool_)
    return EpipolarGeometry(np.zeros((3, 3)), unknown, unknown, none, degeneracy)
