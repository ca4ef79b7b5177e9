"""Fundamental and essential matrix by OpenCV's MAGSAC, and the covariance of their epipoles.

Both are written as aᵀ M b = 0 for one point seen as a and b, homogeneous image points
(right, up)/forward. The epipoles are the null vectors: M e_b = 0, Mᵀ e_a = 0 (Hartley & Zisserman,
Multiple View Geometry, ch. 11). The matrix comes from MAGSAC (Barath et al., CVPR 2019) on samples
of seven or five features. Its errors are up to twice what the noise makes necessary, so a few
Gauss–Newton steps on the Sampson residuals follow; what the matrix is known by is then their
covariance, across what may not change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from visctrl.geometry.robust.least_squares import Options, Solved, gauss_newton
from visctrl.geometry.two_view.degeneracy import Degeneracy

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Features that a linear solution needs: fewer leave no second solution to be told from the first.
MINIMUM_FEATURES = 8
#: OpenCV's thresholds and steps are made for pixels: points are scaled to this noise (px).
_SIGMA_PX = 0.5
#: Gauss–Newton steps after MAGSAC's result, the longest of them (of a unit matrix), and the
#: residual (in standard deviations) from which on a feature does not count in them.
_STEPS, _LONGEST_STEP, _GATE_SIGMAS = 4, 0.2, 3.5
#: A second solution is ruled out by this many standard deviations of the noise's share.
_SIGNIFICANCE = 5.0
#: Standard deviation of an epipole (rad) beyond which it counts as undetermined.
_MAX_SD = 0.5
#: Least spread of the features in any direction of a view, in standard deviations of a point.
_MIN_SPREAD_SIGMAS = 30.0


class Epipole(NamedTuple):
    """An epipole as a unit vector (right, up, forward), and that vector's covariance (3, 3)."""

    direction: Array
    covariance: Array

    @property
    def bearing(self) -> float:
        """Bearing of the line through it (rad, clockwise from forward)."""
        return math.atan2(self.direction[0], self.direction[2])

    @property
    def bearing_sd(self) -> float:
        """First-order standard deviation of the bearing (rad)."""
        right, _, forward = self.direction
        level2 = max(float(right**2 + forward**2), 1e-300)
        gradient = np.array([forward, 0.0, -right]) / level2
        return math.sqrt(max(float(gradient @ self.covariance @ gradient), 0.0))


@dataclass(frozen=True)
class EpipolarGeometry:
    """An essential or fundamental matrix with what is known of it.

    matrix : (3, 3), aᵀ M b = 0, of unit Frobenius norm; zero where nothing was found.
    epipole_a, epipole_b : b's centre seen in a, and a's centre seen in b, up to sign.
    inliers : (N,) correspondences that agree with it.
    degeneracy : what is not determined, if anything.
    """

    matrix: Array
    epipole_a: Epipole
    epipole_b: Epipole
    inliers: Mask
    degeneracy: Degeneracy | None


def magsac(
    points_a: ArrayLike,
    points_b: ArrayLike,
    sigma: float,
    *,
    calibrated: bool,
    seed: int = 0,
    threshold_sigmas: float = 2.0,
    confidence: float = 0.999,
    max_iterations: int = 10_000,
) -> EpipolarGeometry:
    """Find the epipolar geometry of two views in general motion.

    A gross error that happens to lie on its epipolar line cannot be told from a feature; with a
    fifth of gross errors all over the image the epipoles' errors are more than their deviations:
    2.2 times (essential) and 4.2 times (fundamental) in the root mean square of 60 scenes.

    Parameters
    ----------
    points_a, points_b : (N, 2) arrays
        (right, up)/forward of the same features in both views, by the assumed calibration.
    sigma : float
        Standard deviation of one coordinate.
    calibrated : bool
        Whether to find the essential matrix, or the fundamental one, which needs no calibration.
    seed : int
        Of the random samples.
    threshold_sigmas : float
        Residual (in ``sigma``) beyond which a correspondence counts as an outlier.
    confidence, max_iterations : float, int
        The search ends when a better solution is this unlikely, or after so many samples.
    """
    a, b = (np.asarray(points, dtype=np.float64).reshape(-1, 2) for points in (points_a, points_b))
    if len(a) < MINIMUM_FEATURES:
        return _nothing(len(a), Degeneracy.TOO_FEW)
    narrow = min(_spread(a), _spread(b)) < _MIN_SPREAD_SIGMAS * sigma
    none = Degeneracy.NARROW if narrow else Degeneracy.NO_AGREEMENT
    options = cv2.UsacParams()
    options.sampler, options.score = cv2.SAMPLING_UNIFORM, cv2.SCORE_METHOD_MAGSAC
    options.loMethod, options.loIterations = cv2.LOCAL_OPTIM_SIGMA, 10
    options.confidence, options.maxIterations = confidence, max_iterations
    options.threshold, options.randomGeneratorState = threshold_sigmas * _SIGMA_PX, seed
    scale = _SIGMA_PX / sigma
    if calibrated:
        K, straight = np.diag([scale, scale, 1.0]), np.zeros(4)
        M, mask = cv2.findEssentialMat(b * scale, a * scale, K, K, straight, straight, options)
    else:
        M, mask = cv2.findFundamentalMat(b * scale, a * scale, options)
        back = np.diag([scale, scale, 1.0])
        M = None if M is None else back @ M @ back
    if M is None or mask is None or np.count_nonzero(mask) <= MINIMUM_FEATURES:
        return _nothing(len(a), none)
    start = np.asarray(M[:3] / np.linalg.norm(M[:3]), dtype=np.float64)
    a, b = (np.insert(points, 2, 1.0, axis=1) for points in (a, b))
    matrix, inliers = _refined(start, a, b, sigma, calibrated=calibrated)
    if np.count_nonzero(inliers) <= MINIMUM_FEATURES:
        return _nothing(len(a), none)
    return _judged(matrix, a[inliers], b[inliers], sigma, inliers, calibrated=calibrated)


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


def fundamental_tangent(F: Array) -> Array:
    """Return an orthonormal basis (7, 9) of the changes of F (3, 3) that keep rank and norm."""
    U, _, Vt = np.linalg.svd(F)
    fixed = np.stack([np.outer(U[:, 2], Vt[2]).ravel(), F.ravel()])
    return np.asarray(np.linalg.svd(fixed)[2][2:])


def essential_tangent(E: Array) -> Array:
    """Return an orthonormal basis (5, 9) of the changes of E (3, 3) that keep it essential."""
    U, _, Vt = np.linalg.svd(E)
    D = np.diag([1.0, 1.0, 0.0])
    turns = np.zeros((3, 3, 3))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        turns[k, i, j], turns[k, j, i] = -1.0, 1.0
    changes = np.concatenate([U @ turns @ D @ Vt, U @ D @ turns @ Vt]).reshape(6, 9)
    return np.asarray(np.linalg.svd(changes)[2][:5])


def _refined(M: Array, a: Array, b: Array, sigma: float, *, calibrated: bool) -> tuple[Array, Mask]:
    """Return the matrix of least Sampson residuals near M, and the features (N,) it explains.

    Gauss–Newton in the tangent space, back to the nearest matrix of its kind after every step.
    """

    def linearise(M: Array) -> _Linear:
        by_a, by_b = b @ M.T, a @ M
        by_a[:, 2] = by_b[:, 2] = 0.0
        inverse = 1.0 / _gradients(M, a, b)
        residual = np.sum(a * (b @ M.T), axis=1) * inverse
        change = _outer(by_a, b) + _outer(a, by_b)
        jacobian = (_outer(a, b) - (residual * inverse)[:, None] * change) * inverse[:, None]
        tangent = essential_tangent(M) if calibrated else fundamental_tangent(M)
        inliers = np.abs(residual) < _GATE_SIGMAS * sigma
        return _Linear(residual, jacobian, tangent, inliers)

    def moved(M: Array, step: Array) -> Array:
        U, s, Vt = np.linalg.svd(M + step)
        M = (U * ([1.0, 1.0, 0.0] if calibrated else [s[0], s[1], 0.0])) @ Vt
        return np.asarray(M / np.linalg.norm(M))

    options = Options(_STEPS, longest=_LONGEST_STEP)
    found = gauss_newton(linearise, _solve, moved, M, options)
    return found.point, found.linear.inliers


class _Linear(NamedTuple):
    """Residuals (N,), derivatives (N, 9), free directions (k, 9), and who counts (N,)."""

    residual: Array
    jacobian: Array
    tangent: Array
    inliers: Mask


def _solve(at: _Linear) -> Solved[Array]:
    """Return the step (3, 3) of the matrix."""
    J = at.jacobian[at.inliers] @ at.tangent.T
    H = J.T @ J
    damping = 1e-9 * max(float(H.trace()), 1e-300) * np.eye(len(H))
    step = np.linalg.solve(H + damping, -J.T @ at.residual[at.inliers])
    return Solved((step @ at.tangent).reshape(3, 3), math.inf, float(np.linalg.norm(step)))


def _outer(a: Array, b: Array) -> Array:
    """Return the products (N, 9) of the elements of a and b (N, 3), as those of M go."""
    return np.asarray((a[:, :, None] * b[:, None, :]).reshape(-1, 9))


def _judged(
    M: Array, a: Array, b: Array, sigma: float, inliers: Mask, *, calibrated: bool
) -> EpipolarGeometry:
    """Return the epipoles of a matrix, their covariance, and what is not determined.

    a, b : (M, 3) the features that agree.
    """
    weighted = _outer(a, b) / _gradients(M, a, b)[:, None]
    tangent = essential_tangent(M) if calibrated else fundamental_tangent(M)
    axes, signal, needed = _information(M, a, b, sigma, weighted, tangent)
    known = np.maximum(signal, 1e-12 * signal[-1])
    epipole_a, epipole_b = epipoles(M, (axes.T * (sigma**2 / known)) @ axes)
    widest = max(epipole_a.covariance.trace(), epipole_b.covariance.trace())
    degeneracy = None
    _, every, chance = _information(M, a, b, sigma, weighted, np.eye(9))
    if any(_spread(view) < _MIN_SPREAD_SIGMAS * sigma for view in (a, b)):
        degeneracy = Degeneracy.NARROW
    elif every[1] < chance[1]:
        degeneracy = Degeneracy.MANY_SOLUTIONS
    elif signal[0] < needed[0] or widest > _MAX_SD**2:
        degeneracy = Degeneracy.SHORT_BASELINE
    return EpipolarGeometry(M, epipole_a, epipole_b, inliers, degeneracy)


def _information(
    M: Array, a: Array, b: Array, sigma: float, weighted: Array, basis: Array
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
    noise = (sigma * _gradients(axes.reshape(-1, 3, 3), a, b) / _gradients(M, a, b)) ** 2
    needed = _SIGNIFICANCE * np.sqrt(2.0 * (noise**2).sum(axis=1))
    return axes, values - noise.sum(axis=1), needed


def _gradients(M: Array, a: Array, b: Array) -> Array:
    """Return the norms (..., N) of the gradients of aᵀ M b by the four coordinates."""
    by_a, by_b = (b @ np.swapaxes(M, -1, -2))[..., :2], (a @ M)[..., :2]
    square = (by_a**2).sum(axis=-1) + (by_b**2).sum(axis=-1)
    return np.asarray(np.sqrt(np.maximum(square, 1e-300)))


def _spread(points: Array) -> float:
    """Return the standard deviation of points (N, 2 or 3) in that direction where it is least."""
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(values[1]) / math.sqrt(len(points))


def _nothing(count: int, degeneracy: Degeneracy) -> EpipolarGeometry:
    unknown = Epipole(np.array([0.0, 0.0, 1.0]), np.diag([np.inf, np.inf, 0.0]))
    none = np.zeros(count, dtype=np.bool_)
    return EpipolarGeometry(np.zeros((3, 3)), unknown, unknown, none, degeneracy)
