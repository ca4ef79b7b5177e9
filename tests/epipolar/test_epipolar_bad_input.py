"""Bad input to an epipolar run: the message names it and the remedy, and the robot stands still."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from epipolar_world import PERSPECTIVE, World, context, omnidirectional

from visctrl.contracts import Health, Perception
from visctrl.geometry.two_view.degeneracy import Degeneracy
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import STANDSTILL, Frame, Velocity
from visctrl.perception.klt import Klt, KltOptions
from visctrl.robots.errors import InputError
from visctrl.runtime.config import load_scenario, parse_setting
from visctrl.runtime.plan import make_plan
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.session import run_session
from visctrl.runtime.target_view import TargetView
from visctrl.schemes.epipolar.estimator import Epipoles, EpipolesOptions
from visctrl.schemes.epipolar.law_smc import EpipolarSmc, EpipolarSmcOptions
from visctrl.schemes.epipolar.law_smooth import EpipolarSmooth, EpipolarSmoothOptions
from visctrl.schemes.epipolar.motion_solvers import solver_for

Start = tuple[float, float, float]
CAMERAS = [PERSPECTIVE, omnidirectional("hypercatadioptric")]


def plan(*settings: str):
    overrides = [parse_setting(text) for text in ("scheme=epipolar", *settings)]
    return make_plan(load_scenario("default", overrides, REGISTRIES.backends.names()))


def textured(camera: CentralCamera) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.integers(0, 255, (camera.height, camera.width), dtype=np.uint8)


def perception(camera: CentralCamera) -> Perception:
    return Klt(KltOptions(), context(camera))


def stands_still(world: World) -> str:
    """Drive both laws for a while and return what the estimator says."""
    reason = ""
    for law in (
        EpipolarSmooth(EpipolarSmoothOptions(duration_s=20.0), context(world.camera)),
        EpipolarSmc(EpipolarSmcOptions(), context(world.camera)),
    ):
        estimator = Epipoles(EpipolesOptions(), context(world.camera))
        for k in range(8):
            estimate = estimator.update(world.views(world.start, 0.1 * k), STANDSTILL, 0.1)
            assert estimate.health is Health.LOST, estimate.reason
            assert law.update(estimate, STANDSTILL, 0.1).velocity == Velocity(0.0, 0.0)
        reason = estimate.reason
    return reason


def wall(world: World, slope: float, distance: float) -> World:
    """Put all features on one wall."""
    rng = np.random.default_rng(world.seed)
    across, up = rng.uniform(-3.0, 3.0, 800), rng.uniform(-1.0, 2.0, 800)
    points = np.stack([across, distance + slope * across, up], -1)
    shown = [world._project(points, pose)[1] for pose in ((0.0, 0.0, 0.0), world.start)]
    world.points = points[shown[0] & shown[1]][:80]
    world.target, world.initial = world._look((0.0, 0.0, 0.0)), world._look(world.start)
    return world


def test_a_target_of_another_camera_or_size(tmp_path: Path) -> None:
    other = load_camera("perspective").resized(320, 240)
    images = np.zeros((1, 240, 320), dtype=np.uint8)
    TargetView(images, other).save(tmp_path / "target.npz")
    with pytest.raises(InputError) as caught:
        plan("camera.name=perspective", f"target.file={tmp_path / 'target.npz'}")
    for words in ("width 320 there, 640 here", "Use the same camera, or teach again"):
        assert words in str(caught.value)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)
def test_target_images_that_cannot_serve(camera: CentralCamera) -> None:
    shape = (camera.height, camera.width)
    for image, words in (
        (textured(camera)[:100], ["the target image", "is 640x100"]),
        (np.zeros(shape, dtype=np.uint8), ["the target image is blank"]),
        (np.full(shape, 128, dtype=np.uint8), ["the target image"]),
    ):
        words = [w.replace("640x100", f"{camera.width}x100") for w in words]
        with pytest.raises(InputError) as caught:
            perception(camera).set_target([Frame(0.0, 0, image)])
        assert all(word in str(caught.value) for word in words), caught.value


def test_a_start_that_shows_another_place() -> None:
    """Too few matches: what agrees, what is needed, and what to do."""
    eyes = perception(PERSPECTIVE)
    eyes.set_target([Frame(0.0, 0, textured(PERSPECTIVE))])
    with pytest.raises(InputError, match=r"not recognised from the start: \d+ features agree"):
        eyes.set_initial(Frame(0.1, 1, textured(PERSPECTIVE).T[:480, :480].repeat(2, 1)[:, :640]))


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)
@pytest.mark.parametrize("slope", [-0.5, 0.5])
def test_a_scene_of_one_plane(camera: CentralCamera, slope: float) -> None:
    start = (-0.5, -4.0, 0.15)
    # A panoramic camera sees a wall small: with more noise that alone is too little.
    noise = 0.1 if camera.panoramic else 0.5
    world = wall(World(start, camera, noise_px=noise, seed=5), slope, 4.0)
    reason = stands_still(world)
    assert "start and target cannot be told apart" in reason
    assert Degeneracy.ONE_PLANE in reason


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)
def test_ordinary_scenes_are_no_plane(camera: CentralCamera) -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        start = (rng.uniform(-1, 1), rng.uniform(-6, -2), rng.uniform(-0.2, 0.2))
        views = World(start, camera, noise_px=0.5, seed=seed).views(start, 0.0)
        found = solver_for("auto", camera).search(views.current, views.target, views.sigma, 64, 1)
        assert found.determined, (seed, found.reason)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)
def test_a_start_at_the_target(camera: CentralCamera) -> None:
    world = World((0.0, -0.01, 0.0), camera, noise_px=0.5, seed=5)
    reason = stands_still(world)
    assert "start and target cannot be told apart" in reason


def test_a_run_ends_with_the_reason_and_the_robot_where_it_was() -> None:
    """Features so noisy that they do not tell the start from the target."""
    settings = ("backend=mock", "camera.name=perspective", "start.x_m=0", "start.y_m=-0.02")
    alone = ("mock.noise_px=1", "duration_s=10", "final.enabled=false")
    outcome = run_session(plan(*settings, "start.phi_deg=0", *alone))
    assert outcome.exit_code == 1
    assert outcome.summary["status"] == "lost"
    assert "start and target cannot be told apart" in outcome.summary["reason"]
    assert outcome.summary["path_length_m"] == 0.0
