"""What a run says of its end: by the picture alone, and the truth beside it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from visctrl.hal.types import Features, Frame, Pose
from visctrl.reproduce.arrival import CONDITIONS, Condition, judged
from visctrl.runtime.session import run_session
from visctrl.schemes.arrival.check import Answer, ArrivalCheck, Tolerance
from visctrl.studies.run_spec import RunSpec

_TOLERANCE = Tolerance(0.02, np.radians(1.0))


#: Two good ends, and two that are too far off.
PLACES = (
    *(Pose(0.002, -0.003, 0.002), Pose(-0.004, 0.001, -0.003)),
    *(Pose(0.02, 0.02, 0.0), Pose(0.0, 0.0, 0.02)),
)


def run(*settings: str) -> dict[str, Any]:
    return run_session(RunSpec("default", ("backend=mock", *settings)).plan()).summary


def start(x: float, y: float, phi: float) -> tuple[str, ...]:
    return f"start.x_m={x}", f"start.y_m={y}", f"start.phi_deg={phi}"


@pytest.mark.parametrize(
    "settings",
    [
        (*start(0.7, -2.1, 20), "scheme=pose", "mock.noise_px=.5", "mock.actuation.delay_s=.5"),
        (*start(0.05, 0, 0), "mock.noise_px=.3"),
        (
            *start(-0.12, 0.018423337160758, -4.588604629923006),
            *("mock.noise_px=.7", "seed=842596352", "mock.features=100", "duration_s=90"),
        ),
    ],
    ids=["metres off", "5 cm beside", "turned by 180 deg"],
)
def test_a_finished_controller_elsewhere_is_no_success(settings: tuple[str, ...]) -> None:
    summary = run(*settings)
    assert summary["status"] in {"missed", "doubtful"} or summary["truth"]["within_tolerance"]
    assert not summary["truth"]["false_success"]


@pytest.mark.parametrize("scheme", ["trifocal", "epipolar", "pose"])
def test_a_good_end_is_reached_and_the_numbers_are_told(scheme: str) -> None:
    summary = run(f"scheme={scheme}", "mock.noise_px=.5", "seed=3")
    assert summary["status"] == "reached", summary["reason"]
    left, truth = summary["arrival"]["left"], summary["final_error"]
    for key in ("x", "y"):
        assert abs(left[f"{key}_m"] - truth[f"{key}_m"]) < 3.0 * left[f"{key}_sd_m"]
    assert left["distance_sd_m"] < 0.006


@pytest.mark.parametrize("number", [0, len(CONDITIONS) - 1], ids=lambda n: CONDITIONS[n].name)
def test_rendered_pictures_are_judged_rightly(number: int) -> None:
    """The short form of ``visctrl reproduce arrival``: one world, in software."""
    condition: Condition = CONDITIONS[number]
    settings = ("backend=sim", "sim.renderer=tiny", "camera.width=400", "seed=5")
    for case in judged(condition, RunSpec("default", settings), PLACES, drive=False)["cases"]:
        far = np.hypot(case["x_m"], case["y_m"]) > 0.02 or abs(case["phi_deg"]) > 1.0
        near = np.hypot(case["x_m"], case["y_m"]) < 0.01 and abs(case["phi_deg"]) < 0.5
        assert case["answer"] != "there" or not far, case
        assert case["answer"] == "there" or not near, case
        for key, true in (("x", case["x_m"]), ("y", case["y_m"])):
            assert abs(case[f"{key}_fit"] - true) < 4.0 * case[f"{key}_sd"]


def check(frames: list[Frame]) -> ArrivalCheck:
    made = ArrivalCheck(RunSpec("default").plan().camera, 0.75, _TOLERANCE)
    made.set_target(frames)
    return made


@pytest.mark.parametrize("level", [0, 90, 255])
def test_blank_pictures_decide_nothing(level: int) -> None:
    camera = RunSpec("default").plan().camera
    blank = Frame(0.0, 0, np.full((camera.height, camera.width), level, dtype=np.uint8))
    assert check([blank]).judge([blank]).answer is Answer.UNDECIDED


def test_a_camera_that_delivers_nothing_decides_nothing() -> None:
    rng = np.random.default_rng(0)
    camera = RunSpec("default").plan().camera
    noise = rng.integers(0, 255, (camera.height, camera.width)).astype(np.uint8)
    assert check([Frame(0.0, 0, noise)]).judge([Frame(1.0, 1)]).answer is Answer.UNDECIDED
    assert check([Frame(0.0, 0)]).judge([Frame(1.0, 1, noise)]).answer is Answer.UNDECIDED


def test_too_few_named_features_decide_nothing() -> None:
    ids = np.arange(5, dtype=np.int64)
    pixels = 400.0 + 100.0 * np.random.default_rng(0).standard_normal((5, 2))
    few = Frame(0.0, 0, features=Features(ids, pixels))
    assert check([few]).judge([few]).answer is Answer.UNDECIDED
