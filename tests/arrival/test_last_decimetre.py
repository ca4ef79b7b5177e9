"""The last decimetre by the image: starts beside the target, wrong calibration, late commands."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visctrl.contracts import Context, Health
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.types import STANDSTILL, Pose, Velocity
from visctrl.reproduce.arrival_starts import CONDITIONS, places, row
from visctrl.robots.unicycle import along_arc
from visctrl.runtime.session import run_session
from visctrl.schemes.arrival.centre import centre_of_turns
from visctrl.schemes.arrival.displacement import Displacement
from visctrl.schemes.arrival.estimator import CoincidenceEstimate
from visctrl.schemes.arrival.law import RADIUS_M, Coincide, CoincideOptions
from visctrl.studies.run_spec import RunSpec


def run(*chosen: str) -> dict[str, Any]:
    return run_session(RunSpec("default", chosen).plan()).summary


def test_starts_near_the_target_end_on_it() -> None:
    """The short form of ``visctrl reproduce arrival-starts``: everything wrong at once."""
    summaries = [
        run(*CONDITIONS["centre 20 px of 800, gain 0.85, 0.5 s late"], f"seed={number}", *start)
        for number, place in list(enumerate(places()))[4::40]
        for start in [
            [f"start.{k}={v}" for k, v in zip(("x_m", "y_m", "phi_deg"), place, strict=True)]
        ]
    ]
    assert row("", summaries).ok, [summary["reason"] for summary in summaries]


def test_an_end_beside_the_target_is_corrected() -> None:
    settings = ("backend=mock", "scheme=trifocal2d", "mock.noise_px=.5", "seed=3")
    without = run(*settings, "final.enabled=false")
    summary = run(*settings)
    assert without["status"] == "doubtful"
    assert summary["status"] == "reached"
    assert summary["truth"]["distance_m"] < 0.3 * without["truth"]["distance_m"]


def test_where_something_may_stand_in_the_way_nothing_is_backed_into() -> None:
    settings = ("backend=mock", "scheme=pose", "obstacles=[{name: listed, discs: []}]")
    assert RunSpec("default", settings[:2]).plan().final is not None
    assert RunSpec("default", settings).plan().final is None


@pytest.mark.parametrize(("right", "down"), [(8.1, -3.0), (-20.0, 12.0), (0.0, 0.0)])
def test_turns_on_the_spot_give_the_image_centre(right: float, down: float) -> None:
    camera, rng, count = load_camera("hypercatadioptric"), np.random.default_rng(5), 60
    wrong = {"cx": camera.cx + right, "cy": camera.cy + down}
    true = type(camera).model_validate({**camera.model_dump(), **wrong})
    bearing, elevation = rng.uniform(-np.pi, np.pi, count), rng.uniform(-0.4, 0.4, count)

    def see(turn: float) -> np.ndarray[Any, Any]:
        flat = np.cos(elevation)
        rays = [flat * np.sin(bearing + turn), flat * np.cos(bearing + turn), np.sin(elevation)]
        pixels = true.robot_pixels(np.stack(rays, axis=-1))[0] + rng.normal(0, 0.3, (count, 2))
        return camera.robot_rays(pixels)[0]

    turns = [math.radians(angle) for angle in (15.0, 30.0, 45.0)]
    found = centre_of_turns(camera, see(0.0), [see(turn) for turn in turns], 0.0025)
    assert np.all(np.abs(found.offset - [right, down]) < 4.0 * found.sd)
    assert found.sd.max() < 0.4
    assert found.off == bool(right or down)
    assert np.allclose(found.turns, turns, atol=0.005)


def closed_loop(start: Pose, gain: float) -> list[Pose]:
    """Drive an exact unicycle with the law, its estimates exact; return the way."""
    context = Context(load_camera("hypercatadioptric"), None, 0.0, 0.1, 0, lockstep=True)
    law, pose, sent, way = Coincide(CoincideOptions(), context), tuple(start), STANDSTILL, [start]
    for _ in range(1500):
        here = Displacement(Pose(*pose), np.zeros((3, 3)), 0.0, np.empty(0), 1.0, 0.25)
        decision = law.update(CoincidenceEstimate(Health.OK, left=here), sent, 0.1)
        if decision.finished:
            return way
        sent = decision.velocity
        pose = along_arc(pose, Velocity(sent.v * gain, sent.omega * gain), 0.1)
        way.append(Pose(*pose))
    raise AssertionError("it does not end")


@settings(max_examples=40, deadline=None)
@given(
    x=st.floats(-0.2, 0.2),
    y=st.floats(-0.2, 0.2),
    phi=st.floats(-math.pi, math.pi),
    gain=st.floats(0.8, 1.2),
)
def test_the_law_ends_on_the_target_and_stays_near(
    x: float, y: float, phi: float, gain: float
) -> None:
    way = closed_loop(Pose(x, y, phi), gain)
    assert max(math.hypot(*pose[:2]) for pose in way) < RADIUS_M + 0.02
    assert math.hypot(*way[-1][:2]) < 0.008
    assert abs(math.sin(way[-1].phi)) < math.radians(0.2)
