"""The meter behind a run's summary: exact for short runs, of bounded size for long ones."""

from __future__ import annotations

import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from visctrl.hal.types import Pose
from visctrl.runtime.consistency import NAME, chi_square_bounds
from visctrl.runtime.meter import PARTS, Meter


def metered(lateness: np.ndarray, seconds: np.ndarray, features: np.ndarray) -> Meter:
    meter = Meter()
    for late, parts, count in zip(lateness, seconds, features, strict=True):
        record = SimpleNamespace(
            tick=SimpleNamespace(lateness=late),
            stage="main" if count >= 0 else "approach",
            views=range(max(count, 0)),
            seconds=tuple(parts),
            signals=(),
            truth=Pose(0.0, 0.0, 0.0),
        )
        meter.on_tick(record)  # type: ignore[arg-type]
    return meter


@pytest.mark.parametrize("ticks", [1, 7, 1024, 3000])
def test_numbers_of_a_short_run_are_those_of_all_its_ticks(ticks: int) -> None:
    rng = np.random.default_rng(ticks)
    lateness, seconds = rng.exponential(1e-3, ticks), rng.exponential(1e-3, (ticks, len(PARTS)))
    features = rng.integers(5, 50, ticks)
    meter = metered(lateness, seconds, features)
    compute = seconds[:, 1:4].sum(axis=1)
    for name, values in (("lateness", lateness), ("frame", seconds[:, 0]), ("compute", compute)):
        found = meter.spread_ms(name)
        expected = {"median": np.median(values), "p99": np.percentile(values, 99)}
        expected["max"] = values.max()
        assert found == pytest.approx({k: 1000.0 * v for k, v in expected.items()})
    assert meter.features() == {"min": features.min(), "median": np.median(features)}
    assert meter.main_ticks == ticks


def test_without_ticks_there_are_no_numbers() -> None:
    assert set(Meter().spread_ms("lateness").values()) == {None}
    assert set(Meter().features().values()) == {None}


def test_features_count_in_the_main_stage_only() -> None:
    features = np.array([-1, -1, 30, 20, 25])
    meter = metered(np.zeros(5), np.zeros((5, len(PARTS))), features)
    assert meter.features() == {"min": 20, "median": 25.0}
    nothing = metered(np.zeros(3), np.zeros((3, len(PARTS))), np.array([-1, -1, -1]))
    assert nothing.features() == {"min": None, "median": None}


def test_a_long_run_takes_no_more_memory_and_loses_no_extreme() -> None:
    """Thirty thousand ticks; its one slow tick and its one poor frame are not thrown away."""
    ticks = 30_000
    rng = np.random.default_rng(0)
    lateness, seconds = rng.exponential(1e-3, ticks), rng.exponential(1e-3, (ticks, len(PARTS)))
    features = rng.integers(20, 50, ticks)
    seconds[12_345, 2], features[23_457] = 9.0, 3
    meter = metered(lateness, seconds, features)
    found = meter.spread_ms("estimation")
    assert found["max"] == pytest.approx(9000.0)
    assert meter.spread_ms("compute")["max"] == pytest.approx(1000.0 * seconds[12_345, 1:4].sum())
    assert meter.features()["min"] == 3
    assert found["median"] == pytest.approx(1000.0 * np.median(seconds[:, 2]), rel=0.05)
    held = sum(
        value.nbytes if isinstance(value, np.ndarray) else sys.getsizeof(value)
        for value in vars(meter).values()
    )
    assert held < 8192 * 8 * 9


def test_consistency_is_counted_against_the_bounds_of_each_tick() -> None:
    meter = Meter().consistency
    rng = np.random.default_rng(1)
    dof = rng.integers(5, 40, 400)
    values = rng.chisquare(dof)
    for value, degrees in zip(values, dof.tolist(), strict=True):
        low, high = chi_square_bounds(degrees)
        told = {"nis": value, "nis_dof": float(degrees), "nis_low": low, "nis_high": high}
        meter.on_tick(SimpleNamespace(signals=((NAME, told),)))  # type: ignore[arg-type]
    found = meter.summary()
    assert found is not None
    assert found["nees"] is None
    assert found["nis"]["ticks"] == 400
    assert found["nis"]["mean"] == pytest.approx(values.sum() / dof.sum())
    assert math.isclose(found["nis"]["inside"], 0.95, abs_tol=0.03)
