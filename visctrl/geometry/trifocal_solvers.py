"""Solvers for the 1D trifocal tensor: linear, minimal, and RANSAC over minimal samples.

All work in coordinates z of a linear family T = basis·z: every tensor (`UNCALIBRATED`, seven
features), calibrated ones (`CALIBRATED`, five), or those of a known initial view
(`current_view_basis`, three).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.trifocal import Trilinear, sampson_residuals

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


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


def ransac(
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
    rng = np.random.default_rng(seed)
    sample = _distinct(rng, count, unknowns - 1, hypotheses)
    candidates = solve_minimal(relation.error[sample])
    squared = sampson_residuals(relation, candidates) ** 2
    limit = (threshold_sigmas * sigma) ** 2
    best = int(np.argmin(np.minimum(squared, limit).sum(axis=1)))
    return candidates[best], squared[best] < limit


def _distinct(rng: np.random.Generator, count: int, size: int, rows: int) -> NDArray[np.int64]:
    """Return samples (rows, size) of distinct numbers below ``count``."""
    return np.argpartition(rng.random((rows, count)), size - 1, axis=1)[:, :size]
