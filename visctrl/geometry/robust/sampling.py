"""Random sample consensus: hypotheses of minimal samples, scored as M-SAC does.

All hypotheses are solved in one array operation and scored in another, so that a fixed number of
them costs less than a loop that may end early. The score is the truncated sum of squared
residuals (Torr & Zisserman, MLESAC, CVIU 2000): unlike a count of inliers it tells good from
very good.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Samples = NDArray[np.int64]
Score = Callable[[Array], Array]


class Consensus(NamedTuple):
    """The hypotheses of least cost.

    models : (K, ...) the best ones, the first the very best; none where no sample had a solution.
    costs : (K,) their costs.
    inliers : (N,) features within the limit of the first; none without one.
    hypotheses : how many were scored.
    """

    models: Array
    costs: Array
    inliers: Mask
    hypotheses: int


def distinct_samples(count: int, size: int, hypotheses: int, seed: int) -> Samples:
    """Return samples (hypotheses, size) of distinct indices below ``count``, drawn uniformly."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, count, hypotheses)
    # How far each other index lies behind the first, round the circle: a number among those not
    # yet taken, counted past the taken ones.
    steps: list[NDArray[np.int64]] = []
    for taken in range(1, size):
        step = rng.integers(1, count - taken + 1, hypotheses)
        for other in np.sort(steps, axis=0) if steps else ():
            step += step >= other
        steps.append(step)
    return np.stack([first, *((first + step) % count for step in steps)], axis=-1)


def truncated_squares(limit2: float) -> Score:
    """Return M-SAC's score: the sum of squared residuals (M, N), each up to ``limit2``."""

    def score(squared: Array) -> Array:
        return np.asarray(np.minimum(squared, limit2).sum(axis=1))

    return score


def ransac(
    samples: Samples,
    solve: Callable[[Samples], Array],
    squared_residuals: Callable[[Array], Array],
    limit2: float,
    *,
    score: Callable[[float], Score] = truncated_squares,
    keep: int = 1,
) -> Consensus:
    """Return the hypotheses that fit N features best.

    Parameters
    ----------
    samples : (H, S) int array
        Indices of the features of each minimal sample; see `distinct_samples`.
    solve : function
        From samples to models (M, ...), any number of them.
    squared_residuals : function
        From models (M, ...) to the features' squared residuals (M, N).
    limit2 : float
        Squared residual from which on a feature is an outlier.
    score : function
        From ``limit2`` to what gives models their costs (M,) by squared residuals (M, N).
    keep : int
        How many models to return.
    """
    models = solve(samples)
    squared = squared_residuals(models)
    costs = score(limit2)(squared)
    best = np.argsort(costs, kind="stable")[:keep]
    inliers = (squared[best[:1]] < limit2).any(axis=0)
    return Consensus(models[best], costs[best], np.asarray(inliers), len(models))
