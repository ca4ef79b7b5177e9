"""Rays that stand for sonar, against the plan geometry of the scene."""

import math
from pathlib import Path

import numpy as np
import pytest

from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.interfaces import BackendSetup
from visctrl.hal.pioneer.subclasses import find_subclass
from visctrl.hal.pioneer.telemetry import Echo, Telemetry
from visctrl.hal.types import Pose
from visctrl.robots import load_robot
from visctrl.runtime.config import Override, load_scenario
from visctrl.runtime.plan import make_plan
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.session import run_session
from visctrl.sim.backend import SimBackend
from visctrl.sim.options import SimOptions
from visctrl.sim.world.scene import load_scene
from visctrl.sim.world.scene_world import SceneWorld

SMALL_ROOM = str(Path(__file__).with_name("small_room.yaml"))
CAMERA = load_camera("paracatadioptric").resized(200, 150)
P3AT = load_robot("p3at")


@pytest.mark.sim
def test_ranges_are_those_of_the_plan_and_boxes_are_met() -> None:
    start = Pose(0.2, -0.3, 0.1)
    options = SimOptions.model_validate(
        {"scene": SMALL_ROOM, "boxes": [{"x_m": 0.0, "y_m": 1.0}], "show_floor": False}
    )
    backend = SimBackend(
        BackendSetup(P3AT, P3AT.mount("centre"), CAMERA, CAMERA, start, P3AT.operating, options)
    )
    with backend:
        found = backend.base.ranges()
        axle = backend.truth()
    assert axle is not None
    scene = load_scene(SMALL_ROOM)
    plan = SceneWorld(scene, P3AT)
    assert P3AT.sonar is not None
    ring, limit = list(P3AT.sonar.transducers.values()), P3AT.sonar.range_m
    assert len(found) == len(ring) == 16
    expected = np.minimum([plan.sonar(axle, pose) for pose in ring], limit)
    heard = np.minimum([reading.distance for reading in found], limit)
    ahead = [k for k, pose in enumerate(ring) if abs(pose.direction_rad) < 0.3]
    aside = [k for k, pose in enumerate(ring) if abs(pose.direction_rad) > 0.9]
    # The plan does not know of the box ahead.
    assert np.all(heard[ahead] < 1.6)
    assert np.all(expected[ahead] > 1.9)
    np.testing.assert_allclose(heard[aside], expected[aside], atol=0.02)


@pytest.mark.sim
def test_sonar_alone_leads_round_a_box_on_rendered_images() -> None:
    """PyBullet says whether the robot touches; small images, for the sake of time."""
    settings = {
        **{"scheme": "pose", "camera.width": 400, "camera.height": 300, "duration_s": 120.0},
        **{"start.x_m": -0.3, "start.y_m": -3.2, "start.phi_deg": 0.0, "controller.tau_s": 20.0},
        **{"sim.boxes": [{"x_m": -0.1, "y_m": -1.6}], "obstacles": [{"name": "sonar"}]},
    }
    overrides = [Override(tuple(k.split(".")), v, f"--set {k}") for k, v in settings.items()]
    loaded = load_scenario("default", overrides, REGISTRIES.backends.names())
    summary = run_session(make_plan(loaded)).summary
    # The session calls a run missed that has touched anything.
    assert summary["status"] == "reached", summary["reason"]
    assert summary["path_length_m"] > 3.3


def test_a_sonar_reading_says_where_it_looks_and_old_ones_are_forgotten() -> None:
    telemetry = Telemetry(find_subclass("p3dx-sh"))
    telemetry.echoes.update({0: Echo(1.2, 9.5), 3: Echo(5.0, 9.6), 7: Echo(0.8, 3.0)})
    left, ahead = telemetry.ranges(now=10.0, oldest=1.0)
    assert left.age == pytest.approx(0.5)
    assert left.right == pytest.approx(-0.136)
    assert left.bearing == pytest.approx(-math.pi / 2)
    assert left.distance == 1.2
    assert ahead.distance == math.inf
