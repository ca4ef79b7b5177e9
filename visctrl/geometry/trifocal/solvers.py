"""Solvers for the 1D trifocal tensor: linear, minimal, and RANSAC over minimal samples.

All work in coordinates z of a linear family T = basis·z: every tensor (`UNCALIBRATED`, seven
features), calibrated ones (`CALIBRATED`, five), or those of a known initial view
(`current_view_basis`, three).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.robust.sampling import distinct_samples, ransac
from visctrl.geometry.trifocal.tensor import Trilinear, sampson_residuals, unit_bearings

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Median difference of two bearings due to noise alone, in standard deviations of one, and the
#: standard deviation of that median times the root of the number of features.
NOISE_MEDIAN, NOISE_MEDIAN_SD = 0.954, 1.12
#: Views differ when the median is this many of its standard deviations above the noise's.
SIGNIFICANCE = 4.0


def solve_linear(relation: Trilinear) -> Array:
    """Return the unit z (..., k) of least algebraic error over features (..., N, k), N ≥ k − 1.

    Source: the linear estimation of section 3.1; the calibration constraints are imposed by
    solving within their null space, ``relation.within(CALIBRATED)``.
    """
    A = relation.error
    _, vectors = np.linalg.eigh(np.swapaxes(A, -1, -2) @ A)
    return np.asarray(vectors[..., 0])


def solve_minimal(error: Array) -> Array:
    """Return the unit z (..., k) that k − 1 features (..., k − 1, k) fulfil exactly."""
    orthogonal, _ = np.linalg.qr(np.swapaxes(error, -1, -2), mode="complete")
    return np.asarray(orthogonal[..., -1])


def ransac_tensor(
    relation: Trilinear,
    sigma: float,
    *,
    seed: int = 0,
    threshold_sigmas: float = 4.0,
    hypotheses: int = 300,
) -> tuple[Array, Mask]:
    """Return the z (k,) of the minimal sample that most features agree with, and those (N,).

    All hypotheses are solved and scored in one array operation by the truncated sum of squared
    Sampson residuals.

    Parameters
    ----------
    relation : Trilinear
        Of N ≥ k features, in coordinates of the family to search.
    sigma : float
        Standard deviation of one direction (rad).
    seed : int
        Of the random samples.
    threshold_sigmas : float
        Residual (in ``sigma``) beyond which a feature counts as an outlier.
    hypotheses : int
        Number of samples.

    Raises
    ------
    ValueError
        Fewer features than unknowns: nothing is left to judge a hypothesis by.
    """
    count, unknowns = relation.error.shape
    if count < unknowns:
        raise ValueError(f"{count} features, {unknowns} are needed to judge {unknowns} unknowns")
    error = relation.error
    found = ransac(
        distinct_samples(count, unknowns - 1, hypotheses, seed),
        lambda samples: solve_minimal(error[samples]),
        lambda tensors: sampson_residuals(relation, tensors) ** 2,
        (threshold_sigmas * sigma) ** 2,
    )
    return found.models[0], found.inliers


def linear_covariance(relation: Trilinear, z: Array, sigma: float) -> Array:
    """Return the first-order covariance (k, k) of `solve_linear`, across its solution z."""
    values, vectors = np.linalg.eigh(relation.error.T @ relation.error)
    across = vectors[:, 1:] / np.maximum(values[1:], 1e-300)
    inverse = across @ vectors[:, 1:].T
    slopes2 = np.sum(np.square(relation.gradient @ z), axis=0)
    noise = relation.error.T @ ((sigma**2 * slopes2)[:, None] * relation.error)
    return np.asarray(inverse @ noise @ inverse)


def identical_views(rays_a: Array, rays_b: Array, sigma: float) -> bool:
    """Return whether two views (N, 2 or 3) differ by a turn at most, as far as bearings tell."""
    (a, level_a), (b, level_b) = unit_bearings(rays_a), unit_bearings(rays_b)
    turn = np.arctan2(b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0], b[:, 0] * a[:, 0] + b[:, 1] * a[:, 1])
    centre = np.arctan2(np.sin(turn).mean(), np.cos(turn).mean())
    deviation = np.abs(np.sin(turn - centre)) * np.minimum(level_a, level_b)
    bound = NOISE_MEDIAN + SIGNIFICANCE * NOISE_MEDIAN_SD / np.sqrt(len(deviation))
    return bool(np.median(deviation) < bound * sigma)
