"""Confidence intervals against scipy's and against what they promise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from visctrl.studies.intervals import deviation, mean, median, wilson


@given(count=st.integers(1, 500), data=st.data())
def test_wilsons_interval_is_scipys(count: int, data: st.DataObject) -> None:
    successes = data.draw(st.integers(0, count))
    expected = stats.binomtest(successes, count).proportion_ci(0.95, method="wilson")
    found = wilson(successes, count)
    assert found.value == successes / count
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=1e-12)


@pytest.mark.parametrize("n", [2, 5, 40])
def test_the_interval_of_a_mean_is_scipys(n: int) -> None:
    sample = np.random.default_rng(n).normal(3.0, 2.0, n)
    expected = stats.ttest_1samp(sample, 0.0).confidence_interval(0.95)
    found = mean(sample)
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), rel=1e-9)


def test_the_interval_of_a_deviation_agrees_with_scipys_bootstrap() -> None:
    sample = np.random.default_rng(3).gamma(2.0, 1.0, 60)
    found = deviation(sample, np.random.default_rng(0))
    expected = stats.bootstrap(
        (sample,), lambda x, axis: x.std(axis=axis, ddof=1), method="percentile", rng=1
    ).confidence_interval
    assert found.value == pytest.approx(float(sample.std(ddof=1)))
    width = expected.high - expected.low
    assert found.low == pytest.approx(expected.low, abs=0.07 * width)
    assert found.high == pytest.approx(expected.high, abs=0.07 * width)


def test_nineteen_of_twenty_medians_lie_in_their_intervals() -> None:
    """Of any distribution, as many as the binomial distribution promises for this N."""
    count, n = 4000, 37
    samples = np.random.default_rng(5).exponential(size=(count, n))
    hits = 0
    for sample in samples:
        low, high = median(sample)[1:]
        assert low is not None
        assert high is not None
        hits += low <= np.log(2.0) <= high
    promised = 1.0 - 2.0 * stats.binom.cdf(stats.binom.ppf(0.025, n, 0.5) - 1, n, 0.5)
    assert promised > 0.95
    assert stats.binomtest(hits, count, promised).pvalue > 1e-3


def test_small_samples_have_no_interval() -> None:
    assert mean(np.array([2.0])) == (2.0, None, None)
    assert median(np.array([2.0, 1.0, 3.0, 9.0, 5.0])) == (3.0, None, None)
    assert median(np.array([2.0, 1.0, 3.0, 9.0, 5.0, 6.0])) == (4.0, 1.0, 9.0)


def test_a_large_sample_is_resampled_in_parts() -> None:
    n = 4000
    sample = np.random.default_rng(1).normal(size=n)
    found = deviation(sample, np.random.default_rng(2))
    half = 1.96 / np.sqrt(2.0 * n)
    assert found.low == pytest.approx(found.value - half, abs=0.2 * half)
    assert found.high == pytest.approx(found.value + half, abs=0.2 * half)
