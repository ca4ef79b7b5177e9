"""Many runs at once end where single runs end, to the last digits."""

from __future__ import annotations

import numpy as np
import pytest

from visctrl.config import load_scenario, parse_setting
from visctrl.montecarlo.drive import batchable, drive_many
from visctrl.runtime.plan import Plan, make_plan
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.session import run_session

IDEAL = ("approach.enabled=false", "mock.ideal=true")


def plan_from(start: tuple[float, float, float], seed: int, *settings: str) -> Plan:
    x, y, phi = start
    where = (f"start.x_m={x}", f"start.y_m={y}", f"start.phi_deg={phi}", f"seed={seed}")
    changes = [parse_setting(text) for text in (*where, *settings)]
    return make_plan(load_scenario("mock", changes, REGISTRIES.backends.known()))


def single(plan: Plan) -> tuple[list[float], int, bool]:
    summary = run_session(plan).summary
    error = summary["final_error"]
    pose = [error["x_m"], error["y_m"], np.radians(error["phi_deg"])]
    return pose, summary["ticks"], "the controller finished" in summary["reason"]


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_the_batch_is_the_single_run(noise: float) -> None:
    starts = [(-0.3, -2.2, 4.0), (0.35, -2.5, -7.0)]
    plans = [
        plan_from(start, seed, *IDEAL, f"mock.noise_px={noise}")
        for seed, start in enumerate(starts)
    ]
    endings = drive_many(plans)
    for plan, ending in zip(plans, endings, strict=True):
        pose, ticks, finished = single(plan)
        np.testing.assert_allclose(ending.pose, pose, atol=1e-9)
        assert (ending.ticks, ending.finished, ending.alone) == (ticks, finished, False)


def test_out_of_time_is_the_same_too() -> None:
    plan = plan_from((0.2, -3.0, 0.0), 4, *IDEAL, "duration_s=3")
    (ending,) = drive_many([plan])
    pose, ticks, finished = single(plan)
    np.testing.assert_allclose(ending.pose, pose, atol=1e-9)
    assert (ending.ticks, ending.finished) == (ticks, finished) == (ticks, False)


@pytest.mark.parametrize(
    "settings",
    [("approach.enabled=false",), (*IDEAL, "controller.law=published"), ("mock.ideal=true",)],
)
def test_what_it_is_not_made_for_is_run_alone(settings: tuple[str, ...]) -> None:
    plan = plan_from((0.2, -2.2, 0.0), 0, *settings, "duration_s=1")
    assert not batchable(plan)
    (ending,) = drive_many([plan])
    assert ending.alone
    np.testing.assert_allclose(ending.pose, single(plan)[0], atol=1e-12)


def test_a_robot_that_needs_more_than_the_batch_has_is_run_alone() -> None:
    """So much noise that fits are not sound, beside a robot that has none."""
    noisy = plan_from((0.2, -2.2, 0.0), 1, *IDEAL, "mock.noise_px=20", "duration_s=3")
    (ending,) = drive_many([noisy])
    assert ending.alone
    np.testing.assert_allclose(ending.pose, single(noisy)[0], atol=1e-12)
