"""Sampling, consensus and robust scale."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2, norm

from visctrl.geometry.robust.least_squares import (
    Descended,
    Options,
    Problem,
    Solved,
    gauss_newton,
    levenberg_marquardt,
)
from visctrl.geometry.robust.losses import cauchy, huber
from visctrl.geometry.robust.sampling import distinct_samples, ransac
from visctrl.geometry.robust.scale import MAD_TO_SD, mad_sd, upper_mad_sd


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
    wanted = 0.2 * norm.ppf((1 + 0.5 / 0.9) / 2) / norm.ppf(0.75)
    assert mad_sd(residuals) == pytest.approx(wanted, rel=0.05)
    assert upper_mad_sd(residuals) == mad_sd(residuals)
    assert upper_mad_sd(residuals[:4]) >= mad_sd(residuals[:4])


class Curves(Problem[float, None, tuple[float, float], float]):
    """Rosenbrock-like valleys y = (x² − a)²: minima at ±√a, flat in between."""

    def __init__(self, wanted: list[float]) -> None:
        self.wanted, self.calls = wanted, 0

    def linearise(self, points: list[float]) -> tuple[None, list[float], list[tuple[float, float]]]:
        self.calls += 1
        residuals = [x * x - a for x, a in zip(points, self.wanted, strict=True)]
        normals = [(4.0 * x * x, 2.0 * x * r) for x, r in zip(points, residuals, strict=True)]
        return None, [0.5 * r * r for r in residuals], normals

    def steps(
        self, normals: list[tuple[float, float]], damping: list[float]
    ) -> list[Solved[float]]:
        found = []
        for (hessian, gradient), more in zip(normals, damping, strict=True):
            step = -gradient / (hessian * (1.0 + more) + 1e-12)
            found.append(Solved(step, -gradient * step, abs(step)))
        return found

    def moved(self, point: float, step: float, part: float) -> float:
        return point + part * step


@given(st.lists(st.floats(0.1, 9.0), min_size=1, max_size=4), st.floats(0.01, 20.0))
def test_problems_side_by_side_end_where_each_would_alone(wanted: list[float], x: float) -> None:
    options = Options(iterations=60, converged=1e-16, longest=1.0)
    together = levenberg_marquardt(Curves(wanted), [x] * len(wanted), options)
    alone = [levenberg_marquardt(Curves([a]), [x], options).points[0] for a in wanted]
    assert together.points == alone
    assert together.points == pytest.approx(np.sqrt(wanted), rel=1e-6)


@given(st.floats(0.1, 9.0), st.floats(0.01, 20.0))
def test_the_cost_never_rises(wanted: float, x: float) -> None:
    costs = [
        levenberg_marquardt(Curves([wanted]), [x], Options(iterations=n)).costs[0]
        for n in range(1, 12)
    ]
    assert (np.diff(costs) <= 0.0).all()


def test_gauss_newton_ends_by_its_rules() -> None:
    def descend(options: Options) -> Descended[float, float, float]:
        return gauss_newton(
            lambda x: x,
            lambda x: Solved(-(x * x - 4.0) / (2.0 * x), (x * x - 4.0) ** 2, abs(x - 4.0 / x) / 2),
            lambda x, step: x + step,
            10.0,
            options,
        )

    assert descend(Options(iterations=3)).iterations == 3
    settled = descend(Options(iterations=50, converged=1e-20))
    assert settled.iterations < 10
    assert settled.point == pytest.approx(2.0)
    assert descend(Options(iterations=1, longest=0.5)).point == pytest.approx(9.5)


def test_huber_pulls_with_constant_force_beyond_its_threshold() -> None:
    size = np.array([0.0, 1.0, 2.0, 8.0])
    assert size * huber(size, 2.0) == pytest.approx([0.0, 1.0, 2.0, 2.0])
    assert cauchy(size**2) == pytest.approx(1.0 / (1.0 + size**2))
