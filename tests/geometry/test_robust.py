"""Sampling, consensus and robust scale."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2, norm

from visctrl.geometry.robust.sampling import distinct_samples, ransac
from visctrl.geometry.robust.scale import MAD_TO_SD, mad_sd


@given(st.integers(1, 7), st.integers(0, 30), st.integers(0, 2**31))
def test_samples_are_distinct_and_in_range(size: int, more: int, seed: int) -> None:
    samples = distinct_samples(size + more, size, 50, seed)
    assert samples.shape == (50, size)
    assert samples.min() >= 0
    assert samples.max() < size + more
    assert all(len(set(row)) == size for row in samples.tolist())


@pytest.mark.parametrize("size", [2, 3, 4])
def test_every_ordered_sample_is_as_likely(size: int) -> None:
    """Pearson's test of 60,000 samples out of five features, at one in a thousand."""
    samples = distinct_samples(5, size, 60_000, 1)
    _, counts = np.unique(samples @ 5 ** np.arange(size), return_counts=True)
    cells = int(np.prod(np.arange(5, 5 - size, -1)))
    assert len(counts) == cells
    expected = 60_000 / cells
    assert ((counts - expected) ** 2 / expected).sum() < chi2.ppf(0.999, cells - 1)


def test_consensus_finds_a_line_among_outliers() -> None:
    rng = np.random.default_rng(2)
    x = rng.uniform(-1.0, 1.0, 100)
    y = 0.3 * x - 0.1 + rng.normal(0.0, 0.01, 100)
    y[:60] = rng.uniform(-2.0, 2.0, 60)

    def solve(samples: np.ndarray) -> np.ndarray:
        a, b = samples.T
        slope = (y[b] - y[a]) / (x[b] - x[a])
        return np.stack([slope, y[a] - slope * x[a]], axis=-1)

    found = ransac(
        distinct_samples(100, 2, 300, 3),
        solve,
        lambda lines: (y - lines[:, :1] * x - lines[:, 1:]) ** 2,
        0.03**2,
        keep=3,
    )
    assert found.models[0] == pytest.approx([0.3, -0.1], abs=0.03)
    assert found.inliers[60:].mean() > 0.9 > 0.1 > found.inliers[:60].mean()
    assert found.hypotheses == 300
    assert (np.diff(found.costs) >= 0.0).all()


def test_consensus_without_a_solution_is_empty() -> None:
    found = ransac(
        distinct_samples(9, 2, 5, 0),
        lambda samples: np.zeros((0, 2)),
        lambda models: np.zeros((len(models), 9)),
        1.0,
    )
    assert len(found.models) == 0
    assert not found.inliers.any()


def test_mad_is_the_standard_deviation_of_normal_residuals() -> None:
    assert pytest.approx(1.0 / norm.ppf(0.75), abs=1e-4) == MAD_TO_SD
    residuals = np.random.default_rng(4).normal(0.0, 0.2, 20_001)
    residuals[:2000] = 50.0
    assert mad_sd(residuals) == pytest.approx(
        0.2 * norm.ppf((1 + 0.5 / 0.9) / 2) / norm.ppf(0.75), rel=0.05
    )
