"""NEES and NIS on line: against hand calculations, and over whole runs."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from visctrl.contracts import Health
from visctrl.hal.types import Pose
from visctrl.robots.errors import InputError
from visctrl.runtime.config import Override, load_scenario
from visctrl.runtime.consistency import Consistency, chi_square_bounds, nees
from visctrl.runtime.plan import make_plan
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.session import Outcome, run_session
from visctrl.schemes.pose.estimate import Need, PoseEstimate


def estimate(pose: Pose, need: Need = Need.NOTHING) -> PoseEstimate:
    covariance = np.diag([0.01, 0.04, 0.0001])
    return PoseEstimate(health=Health.OK, pose=pose, covariance=covariance, initial=pose, need=need)


def run(settings: dict[str, Any], out: Path | None = None) -> Outcome:
    base: dict[str, Any] = {"backend": "mock", "scheme": "pose"}
    overrides = [
        Override(tuple(key.split(".")), value, f"--set {key}={value}")
        for key, value in (base | settings).items()
    ]
    plan = make_plan(load_scenario("default", overrides, REGISTRIES.backends.names()))
    return run_session(plan, out)


def test_nees_weighs_each_error_by_its_deviation() -> None:
    found = nees(estimate(Pose(0.1, -0.4, math.pi - 0.005)), Pose(0.0, 0.0, -math.pi + 0.005))
    assert found == pytest.approx(1.0 + 4.0 + 1.0)


def test_bounds_are_those_of_chi_square() -> None:
    # From printed tables, 0.025 and 0.975.
    assert chi_square_bounds(3) == pytest.approx((0.216, 9.348), abs=1e-3)
    assert chi_square_bounds(40) == pytest.approx((24.433, 59.342), abs=1e-3)


def test_nothing_is_judged_before_there_is_a_pose_or_without_truth() -> None:
    judge, here = Consistency(), Pose(0.0, 0.0, 0.0)
    assert judge.values(estimate(here, Need.FORWARD), here, {}) == {}
    assert judge.values(estimate(here), None, {}) == {}
    assert set(judge.values(estimate(here), None, {"nis": 3.0, "nis_dof": 4.0})) == {
        *("nis", "nis_dof", "nis_low", "nis_high")
    }


def test_a_run_reports_its_consistency(tmp_path: Path) -> None:
    settings = {"mock.noise_px": 0.5, "duration_s": 30.0}
    summary = run(settings, tmp_path / "run").summary
    with (tmp_path / "run" / "ticks.csv").open() as file:
        ticks = list(csv.DictReader(file))
    column = [float(v) for row in ticks if (v := row["consistency.nees [1]"])]
    assert len(column) == summary["consistency"]["nees"]["ticks"] > 200
    assert summary["consistency"]["nees"]["mean"] == pytest.approx(sum(column) / len(column) / 3)
    assert 0.9 < summary["consistency"]["nis"]["mean"] < 1.1
    assert summary["consistency"]["nis"]["inside"] > 0.9
    # Where nobody reads the signals as well.
    assert run(settings).summary["consistency"] == summary["consistency"]


def test_noise_that_the_filter_does_not_know_of_shows(tmp_path: Path) -> None:
    settings = {"mock.noise_px": 1.0, "perception.noise_px": 0.5, "duration_s": 15.0}
    # The source's filter has no way to doubt what it is told.
    ekf = run(settings | {"estimator.name": "ekf"}).summary
    assert ekf["consistency"]["nis"]["mean"] > 1.8
    run(settings, tmp_path / "run")
    with (tmp_path / "run" / "ticks.csv").open() as file:
        factor = [row["transfer.noise_factor [1]"] for row in csv.DictReader(file)]
    assert float(factor[-1]) == pytest.approx(2.0, rel=0.25)


def test_other_schemes_have_nothing_to_judge(tmp_path: Path) -> None:
    outcome = run({"scheme": "trifocal", "duration_s": 1.0}, tmp_path / "run")
    assert outcome.summary["consistency"] is None
    assert "consistency" not in (tmp_path / "run" / "ticks.csv").read_text()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"camera.mount": "centre"}, "needs it off the turning centre"),
        ({"controller.lambda_x": 20.0}, "must be under 2/Ts = 20"),
        ({"controller.lambda_y": 4.0, "rate_hz": 2.0}, "must be under 2/Ts = 4"),
        ({"controller.lambda_x": 0.0}, "greater than 0"),
        (
            {"obstacles": [{"name": "listed", "discs": [{"x_m": 0.3, "y_m": 0.3}]}]},
            "the target leaves 0.0[0-9] m to the one at .0.3, 0.3. m",
        ),
        (
            {
                "obstacles": [{"name": "listed", "discs": [{"x_m": 2.0, "y_m": -1.0}]}],
                "controller.goals": [{"x_m": 2.1, "y_m": -1.0}],
            },
            "controller.goals.0 leaves 0.00 m",
        ),
    ],
)
def test_what_cannot_be_driven_is_refused_before_anything_moves(
    tmp_path: Path, settings: dict[str, Any], said: str
) -> None:
    with pytest.raises(InputError, match=said) as caught:
        run(settings, tmp_path / "run")
    assert caught.value.exit_code == 2
    assert not (tmp_path / "run").exists()


@given(st.integers(0, 2**32))
def test_nees_is_the_quadratic_form_of_the_inverse_covariance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3)) * rng.uniform(1e-3, 1.0, (3, 1)) + 1e-4 * np.eye(3)
    error = rng.uniform(-0.5, 0.5, 3)
    covariance = root @ root.T
    judged = replace(estimate(Pose(*error)), covariance=covariance)
    expected = error @ np.linalg.solve(covariance, error)
    condition = np.linalg.cond(covariance)
    assert nees(judged, Pose(0.0, 0.0, 0.0)) == pytest.approx(expected, rel=1e-13 * condition)


@pytest.mark.parametrize("variance", [0.0, -1.0, math.nan])
def test_without_a_proper_covariance_there_is_no_nees(variance: float) -> None:
    judged = replace(estimate(Pose(0.1, 0, 0)), covariance=np.diag([1.0, variance, 1.0]))
    assert math.isnan(nees(judged, Pose(0.0, 0.0, 0.0)))
