"""Many runs at once end where single runs end, to the last digits, and whatever else is run."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from many_plans import plan_from, random_plans

from visctrl.montecarlo import drive
from visctrl.montecarlo.drive import Ending, drive_many, drive_together
from visctrl.montecarlo.kinds import alike, batchable
from visctrl.runtime.plan import Plan
from visctrl.runtime.session import run_session

IDEAL = ("approach.enabled=false", "mock.ideal=true")


def assert_same(ending: Ending, plan: Plan) -> None:
    """Compare with the ordinary session: numbers to 1e-9, words and counts exactly."""
    summary, single = ending.summary, run_session(plan).summary
    for key in ("status", "reason", "ticks"):
        assert summary[key] == single[key]
    assert summary["features"]["min"] == single["features"]["min"]
    np.testing.assert_allclose(numbers(summary), numbers(single), rtol=0.0, atol=1e-9)


def numbers(summary: dict[str, Any]) -> list[float]:
    return [*summary["final_error"].values(), summary["path_length_m"], summary["duration_s"]]


@pytest.mark.parametrize(
    "settings",
    [
        IDEAL,
        (*IDEAL, "mock.noise_px=0.5"),
        ("mock.noise_px=0.5", "target.frames=3", "camera_error.tilt_deg=0.3"),
        ("mock.noise_px=0.3", "robot=p3at", "camera.name=fisheye", "controller.tau_s=12"),
        ("mock.actuation.quantise=false", "controller.whole_units=false"),
    ],
    ids=["ideal", "ideal, noise", "default", "p3at, fisheye", "exact base"],
)
def test_the_batch_is_the_single_run(settings: tuple[str, ...]) -> None:
    plans = random_plans(3, *settings)
    for plan, ending in zip(plans, drive_many(plans), strict=True):
        assert not ending.alone
        assert_same(ending, plan)


def test_retreats_are_the_same_too() -> None:
    # So much damping leaves a lateral error, which the robot sees when it has settled.
    plans = random_plans(3, "mock.noise_px=0.5", "controller.damping=0.5")
    endings = drive_many(plans)
    # Back and forth: no way from these starts is that long.
    assert max(ending.summary["path_length_m"] for ending in endings) > 3.0
    for plan, ending in zip(plans, endings, strict=True):
        assert not ending.alone
        assert_same(ending, plan)


def test_points_may_go_out_of_sight() -> None:
    plans = random_plans(3, "mock.noise_px=0.5", "camera.name=perspective", angle=15.0)
    endings = drive_many(plans)
    assert min(ending.summary["features"]["min"] for ending in endings) < 60
    for plan, ending in zip(plans, endings, strict=True):
        assert not ending.alone
        assert_same(ending, plan)


def test_out_of_time_is_the_same_too() -> None:
    plans = [plan_from((0.2, -3.0, 0.0), 4, *IDEAL, "duration_s=3")]
    plans += [plan_from((0.2, -2.0, 30.0), 4, "duration_s=3")]
    for plan, ending in zip(plans, drive_many(plans), strict=True):
        assert ending.summary["status"] == "missed"
        assert_same(ending, plan)


def test_an_ending_does_not_depend_on_which_others_there_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Bit by bit: in any order, alone, in batches of any size, beside runs of another kind."""
    plans = random_plans(7, "mock.noise_px=0.5", "duration_s=5")
    others = random_plans(2, *IDEAL, "duration_s=5")
    together = [ending and ending.summary for ending in drive_together(plans)]
    assert len({str(summary) for summary in together}) == len(plans)
    mixed = [others[0], *plans[::-1], others[1]]
    assert [e and e.summary for e in drive_together(mixed)][-2:0:-1] == together
    for size in (1, 2, 4):
        monkeypatch.setattr(drive, "BATCH", size)
        assert [e and e.summary for e in drive_together(plans)] == together


@pytest.mark.parametrize(
    "settings",
    [
        (*IDEAL, "controller.law=published"),
        ("controller.name=trifocal-smooth",),
        ("estimator.method=linear5",),
        ("mock.faults.frame_drop_probability=0.1",),
        ("mock.scatter.v_m_s=0.01",),
        ("mock.actuation.delay_s=0.1",),
        ("camera.mount=front",),
        ("rate_hz=2",),
        ("scheme=pose",),
    ],
)
def test_what_it_is_not_made_for_is_run_alone(settings: tuple[str, ...]) -> None:
    plan = plan_from((0.2, -2.2, 0.0), 0, *settings, "duration_s=1")
    assert not batchable(plan)
    (ending,) = drive_many([plan])
    assert ending.alone
    assert_same(ending, plan)


@pytest.mark.parametrize(
    ("start", "settings"),
    [
        # So much noise that fits are not sound; fewer features than perception asks for, now and
        # then; a start on the target, where there is no baseline.
        ((0.2, -2.2, 0.0), ("mock.noise_px=20", "duration_s=3")),
        ((0.3, -2.2, -12.0), ("camera.name=perspective", "perception.min_features=60")),
        ((0.0, 0.0, 3.0), ("duration_s=3",)),
    ],
    ids=["noise", "few features", "on the target"],
)
def test_a_robot_that_needs_more_than_the_batch_has_is_run_alone(
    start: tuple[float, float, float], settings: tuple[str, ...]
) -> None:
    odd = plan_from(start, 1, *IDEAL, *settings)
    beside = plan_from((0.2, -2.2, 0.0), 1, *IDEAL, "duration_s=3")
    assert batchable(odd)
    first, second = drive_many([odd, beside])
    assert (first.alone, second.alone) == (True, False)
    assert_same(first, odd)


def test_only_start_and_seed_may_differ_within_a_batch() -> None:
    plan = plan_from((0.2, -2.2, 0.0), 0, "camera.width=1024")
    assert alike(plan, plan_from((-0.2, -1.2, 3.0), 7, "camera.width=1024"))
    for setting in ("camera.width=512", "mock.noise_px=1", "duration_s=9", "robot=p3at"):
        assert not alike(plan, plan_from((0.2, -2.2, 0.0), 0, "camera.width=1024", setting))
