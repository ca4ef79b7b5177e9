"""The mock against the models it claims to follow, each from another source than its own code."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from visctrl.hal.cameras.catalogue import camera_names, load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.errors import InputError, LinkError
from visctrl.hal.interfaces import BackendSetup
from visctrl.hal.mock.backend import MockBackend, MockOptions, Purpose
from visctrl.hal.mock.scene import scatter, scatter_many, seen_from
from visctrl.hal.types import Pose, Velocity
from visctrl.robots import Limits, load_robot
from visctrl.robots.unicycle import along_arc, step_exact

ROBOT = load_robot("p3dx")
IDEAL = MockOptions(ideal=True)
START = Pose(0.5, -2.0, 0.3)
Open = Callable[..., MockBackend]
coordinates = st.floats(-10.0, 10.0)


@pytest.fixture
def opened() -> Any:
    backends: list[MockBackend] = []

    def make(
        options: MockOptions = IDEAL,
        *,
        start: Pose = START,
        camera: str | CentralCamera = "hypercatadioptric",
        true_camera: CentralCamera | None = None,
        mount: str = "centre",
        limits: Limits | None = ROBOT.operating,
        seed: int = 0,
    ) -> MockBackend:
        model = load_camera(camera) if isinstance(camera, str) else camera
        setup = BackendSetup(
            robot=ROBOT,
            mount=ROBOT.mount(mount),
            camera=model,
            true_camera=true_camera or model,
            start=start,
            limits=limits,
            options=options,
            seed=seed,
        )
        backend = MockBackend(setup)
        backend.open()
        backends.append(backend)
        return backend

    yield make
    for backend in backends:
        backend.close()


@given(coordinates, coordinates, coordinates, st.floats(-2, 2), st.floats(-4, 4), st.floats(0, 3))
def test_scalar_arc_is_the_array_arc(
    x: float, y: float, phi: float, v: float, omega: float, dt: float
) -> None:
    expected = step_exact((x, y, phi), v, omega, dt)
    np.testing.assert_allclose(along_arc((x, y, phi), Velocity(v, omega), dt), expected, atol=1e-9)


@pytest.mark.parametrize("mount", ["centre", "front"])
def test_an_ideal_robot_moves_its_camera_on_the_exact_arc(opened: Open, mount: str) -> None:
    backend = opened(mount=mount)
    pose: Any = Pose(0.5, -2.0, 0.3)
    offset = ROBOT.mount(mount).forward_m
    t = 0.0
    for v, omega in ((0.3, 0.0), (0.0, 1.2), (1.7, -0.9)):
        assert backend.base.command(Velocity(v, omega)) == (v, omega)
        t += 0.7
        backend.clock.sleep_until(t)
        pose = step_exact(pose, v, omega, 0.7, offset)
    np.testing.assert_allclose(backend.truth(), pose, atol=1e-12)


def test_commands_are_bounded_and_in_whole_units(opened: Open) -> None:
    backend = opened(MockOptions())
    sent = backend.base.command(Velocity(0.12345, math.radians(10.4)))
    assert sent.v == pytest.approx(0.123)
    assert math.degrees(sent.omega) == pytest.approx(10.0)
    assert abs(backend.base.command(Velocity(9.0, 0.0)).v) <= ROBOT.operating.v_m_s


def test_the_ramp_takes_its_time(opened: Open) -> None:
    """From rest to v at a constant acceleration: v²/2a on the way, then v t."""
    backend = opened(MockOptions(), start=Pose(0.0, -2.0, 0.0))
    v, a, t = 0.3, ROBOT.operating.acceleration_m_s2, 3.0
    backend.base.command(Velocity(v, 0.0))
    backend.clock.sleep_until(t)
    truth = backend.truth()
    assert truth is not None
    assert truth.y + 2.0 == pytest.approx(v * t - v * v / (2 * a), abs=v * 0.01)


def test_delay_and_slip_are_there_and_odometry_knows_of_the_delay_only(opened: Open) -> None:
    actuation = {"quantise": False, "delay_s": 0.5, "slip_v": 0.1}
    backend = opened(
        MockOptions.model_validate({"actuation": actuation}),
        start=Pose(0.0, -2.0, 0.0),
        limits=ROBOT.hardware.model_copy(update={"acceleration_m_s2": 1e6}),
    )
    backend.base.command(Velocity(0.3, 0.0))
    backend.clock.sleep_until(0.5)
    assert backend.truth() == pytest.approx((0.0, -2.0, 0.0))
    backend.clock.sleep_until(2.5)
    assert backend.truth() == pytest.approx((0.0, -2.0 + 0.9 * 0.6, 0.0), abs=1e-9)
    odometry = backend.base.odometry()
    assert odometry.pose == pytest.approx((0.0, 0.6, 0.0), abs=1e-9)
    assert odometry.velocity.v == pytest.approx(0.3)
    assert odometry.stamp == 2.5


@pytest.mark.parametrize("camera", camera_names())
def test_features_are_the_true_cameras_images_of_fixed_points(opened: Open, camera: str) -> None:
    """Rays of the same feature from three poses meet in one point."""
    model = load_camera(camera)
    true = model.altered(fx=1.1 * model.fx, fy=1.1 * model.fy, cx=model.cx + 7.0)
    start = Pose(0.2, -1.5, 0.1)
    backend = opened(camera=model, true_camera=true, start=start)
    poses, rays, ids = [], [], []
    t = 0.0
    for v, omega in ((0.3, 0.05), (0.25, -0.2), (0.3, 0.1)):
        frame, pose = backend.camera.read(), backend.truth()
        assert frame.features is not None
        assert frame.image is None
        assert pose is not None
        directions, valid = true.robot_rays(frame.features.pixels)
        assert valid.all()
        s, c = math.sin(pose.phi), math.cos(pose.phi)
        world = directions @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        poses.append(np.array([pose.x, pose.y, 0.0]))
        rays.append(world)
        ids.append(frame.features.ids)
        backend.base.command(Velocity(v, omega))
        t += 1.0
        backend.clock.sleep_until(t)
    common = sorted(set(ids[0]) & set(ids[1]) & set(ids[2]))
    assert len(common) > 40
    for name in common:
        lines = [r[list(i).index(name)] for r, i in zip(rays, ids, strict=True)]
        blocks = [np.eye(3) - np.outer(d, d) for d in lines]
        point = np.linalg.solve(sum(blocks), sum(b @ p for b, p in zip(blocks, poses, strict=True)))
        assert (
            max(np.linalg.norm(b @ (point - p)) for b, p in zip(blocks, poses, strict=True)) < 1e-8
        )


def test_noise_has_the_size_asked_for_and_is_new_in_every_frame(opened: Open) -> None:
    clean = opened(MockOptions(features=400))
    noisy = opened(MockOptions(features=400, noise_px=0.7))
    exact = clean.camera.read().features
    errors = []
    for k in range(20):
        noisy.clock.sleep_until(0.1 * k)
        features = noisy.camera.read().features
        assert exact is not None
        assert features is not None
        assert np.array_equal(features.ids, exact.ids), "noise moves features, it hides none"
        errors.append(features.pixels - exact.pixels)
    sample = np.array(errors)
    # Four standard errors of the mean and of the standard deviation.
    assert abs(sample.mean()) < 4 * 0.7 / math.sqrt(sample.size)
    assert abs(sample.std() - 0.7) < 4 * 0.7 / math.sqrt(2 * sample.size)
    assert abs(np.corrcoef(sample[0].ravel(), sample[1].ravel())[0, 1]) < 0.2


def test_frames_of_one_instant_are_one_frame_and_later_ones_are_new(opened: Open) -> None:
    backend = opened(MockOptions(noise_px=1.0))
    first = backend.camera.read()
    assert backend.camera.read() is first
    backend.clock.sleep_until(0.1)
    second = backend.camera.read()
    assert (second.stamp, second.sequence) == (0.1, first.sequence + 1)


def test_teaching_shows_the_target_with_fresh_noise_and_moves_nothing(opened: Open) -> None:
    backend = opened(MockOptions(noise_px=1.0, features=300))
    before = backend.truth()
    frames = backend.teach(3)
    assert backend.truth() == before
    at_target = opened(MockOptions(features=300)).teach()[0].features
    assert at_target is not None
    for frame in frames:
        assert frame.features is not None
        error = frame.features.pixels - at_target.pixels
        assert error.std() == pytest.approx(1.0, abs=0.15)
    one, two = frames[0].features, frames[1].features
    assert one is not None
    assert two is not None
    assert not np.array_equal(one.pixels, two.pixels)


def test_the_seed_makes_the_scene_and_the_noise(opened: Open) -> None:
    same, again, other = (opened(MockOptions(noise_px=1.0), seed=seed) for seed in (5, 5, 6))
    pixels = [backend.camera.read().features for backend in (same, again, other)]
    assert all(features is not None for features in pixels)
    assert np.array_equal(pixels[0].pixels, pixels[1].pixels)
    assert pixels[0].pixels.shape != pixels[2].pixels.shape or not np.allclose(
        pixels[0].pixels, pixels[2].pixels
    )


@pytest.mark.parametrize("camera", camera_names())
@pytest.mark.parametrize(
    "start", [Pose(4, -8, math.radians(40)), Pose(-0.3, -1.3, 0.0), Pose(-7, -18, -0.17)]
)
def test_every_point_of_a_scene_is_seen_all_the_way(camera: str, start: Pose) -> None:
    model, mount = load_camera(camera), ROBOT.mount("centre")
    points = scatter(100, (2.0, 8.0), model, mount, start, np.random.default_rng(3))
    assert points.shape == (100, 3)
    assert (points[:, 2] > -mount.height_m).all(), "above the floor"
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        pose = Pose(share * start.x, share * start.y, share * start.phi)
        assert model.robot_pixels(seen_from(points, pose))[1].all()
        distance = np.hypot(points[:, 0] - pose.x, points[:, 1] - pose.y)
        assert distance.min() > 1.99


def test_scenes_spread_all_round_a_panoramic_camera() -> None:
    model = load_camera("paracatadioptric")
    start = Pose(-5.0, -12.0, -0.5)
    points = scatter(400, (2.0, 8.0), model, ROBOT.mount("centre"), start, np.random.default_rng(0))
    quadrants = np.unique((points[:, 0] > -2.5).astype(int) + 2 * (points[:, 1] > -6.0))
    assert len(quadrants) == 4


def test_a_start_that_sees_nothing_of_the_target_is_refused(opened: Open) -> None:
    with pytest.raises(InputError, match=r"start \(0 m, -2 m, 180 deg\).*sees too little"):
        opened(camera="perspective", start=Pose(0.0, -2.0, math.pi))


def test_options_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(ValidationError, match="near_m"):
        MockOptions(near_m=3.0, far_m=2.0)
    with pytest.raises(ValidationError, match="ideal"):
        MockOptions.model_validate({"ideal": True, "actuation": {"delay_s": 1.0}})


def test_closing_twice_is_fine_and_the_truth_is_gone(opened: Open) -> None:
    backend = opened()
    backend.close()
    backend.close()
    assert backend.truth() is None
    with pytest.raises(LinkError, match="closed"):
        backend.base.command(Velocity(0.1, 0.0))


@pytest.mark.parametrize("camera", ["hypercatadioptric", "perspective"])
def test_a_scene_does_not_depend_on_which_others_are_made_with_it(camera: str) -> None:
    """Of many features, too, for which more has to be drawn; and beside a start that fails."""
    model, mount = load_camera(camera), ROBOT.mount("centre")
    starts = [Pose(0.1 * k, -1.0 - k, 0.05 * k) for k in range(4)] + [Pose(0.0, -2.0, math.pi)]
    for count in (20, 1500):
        rngs = [Purpose.SCENE.generator(seed) for seed in range(5)]
        scenes = scatter_many(count, (2.0, 8.0), model, mount, starts, rngs)
        assert (scenes[-1] is None) == (not model.panoramic)
        for seed, (start, scene) in enumerate(zip(starts, scenes, strict=True)):
            if scene is not None:
                rng = Purpose.SCENE.generator(seed)
                alone = scatter(count, (2.0, 8.0), model, mount, start, rng)
                np.testing.assert_array_equal(scene, alone)


def test_every_purpose_has_random_numbers_of_its_own() -> None:
    drawn = {
        (seed, purpose): purpose.generator(seed).random() for seed in (0, 1) for purpose in Purpose
    }
    assert len(set(drawn.values())) == len(drawn) == 10
