"""95 % confidence intervals of shares, means, medians and standard deviations."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

CONFIDENCE = 0.95
_RESAMPLES = 2000
#: Values drawn at a time, so that a large sample does not fill the memory.
_CHUNK = 2_000_000

Sample = NDArray[np.float64]


class Interval(NamedTuple):
    """An estimate and the ends of its confidence interval; None where there is none."""

    value: float
    low: float | None
    high: float | None


def wilson(successes: int, count: int) -> Interval:
    """Return a share with Wilson's score interval (Wilson 1927, eq. for two-sided limits).

    Unlike the normal approximation it is sound for few runs and for shares near 0 and 1.
    """
    from scipy.stats import binomtest

    found = binomtest(successes, count).proportion_ci(CONFIDENCE, method="wilson")
    return Interval(successes / count, float(found.low), float(found.high))


def mean(sample: Sample) -> Interval:
    """Return the mean of a sample (N,) with Student's t interval; no interval for N = 1."""
    from scipy.special import stdtrit

    n = len(sample)
    centre = float(sample.mean())
    if n < 2:
        return Interval(centre, None, None)
    half = float(stdtrit(n - 1, 0.5 + CONFIDENCE / 2.0)) * float(sample.std(ddof=1)) / math.sqrt(n)
    return Interval(centre, centre - half, centre + half)


def median(sample: Sample) -> Interval:
    """Return the median of a sample (N,), its interval between order statistics.

    The r-th value from either end bounds the true median of any distribution with a probability
    of at least 1 − 2 P(B < r), B binomial (N, ½). There is no such r below N = 6.
    """
    from scipy.special import bdtr

    n = len(sample)
    tail = (1.0 - CONFIDENCE) / 2.0
    r = int(np.count_nonzero(bdtr(np.arange(float(n)), n, 0.5) <= tail))
    ordered = np.sort(sample)
    value = float(np.median(ordered))
    if r == 0:
        return Interval(value, None, None)
    return Interval(value, float(ordered[r - 1]), float(ordered[n - r]))


def deviation(sample: Sample, rng: np.random.Generator) -> Interval:
    """Return the standard deviation of a sample (N ≥ 2,) with its percentile bootstrap interval.

    Parameters
    ----------
    sample : array (N,)
    rng : numpy Generator
        Draws the resamples (N of N with replacement, 2000 times).
    """
    n = len(sample)
    centred = sample - sample.mean()
    rows = max(1, _CHUNK // n)
    found = [
        centred[rng.integers(n, size=(min(rows, _RESAMPLES - first), n))].std(axis=1, ddof=1)
        for first in range(0, _RESAMPLES, rows)
    ]
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(np.concatenate(found), (tail, 100.0 - tail))
    return Interval(float(sample.std(ddof=1)), float(low), float(high))
