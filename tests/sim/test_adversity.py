"""What spoils simulated runs on request: changed scenes, late and shaken cameras, wrong wheels."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from visctrl.hal.actuation import ActuationOptions, Scatter, WheelErrors
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.interfaces import BackendSetup
from visctrl.hal.types import Pose, Velocity
from visctrl.robots import load_robot
from visctrl.sim.backend import SimBackend
from visctrl.sim.options import Changes, SimOptions
from visctrl.sim.render.imaging import Sensor
from visctrl.sim.render.shake import Shake
from visctrl.sim.world.changes import changed
from visctrl.sim.world.eye import Eye
from visctrl.sim.world.light import Light
from visctrl.sim.world.people import people
from visctrl.sim.world.scene import Scene, keep_clear, load_scene, overlap
from visctrl.sim.world.world import displaced

CAMERA = load_camera("hypercatadioptric").resized(160, 120)
SMALL = str(Path(__file__).parent / "small_room.yaml")
ratios = st.floats(0.7, 1.4)


@given(st.floats(-0.4, 0.4), st.floats(-1.0, 1.0), ratios, ratios, ratios, st.floats(-0.2, 0.2))
def test_odometry_takes_wrong_wheels_for_right_ones(
    v: float, omega: float, left: float, right: float, track: float, slip: float
) -> None:
    wheels = WheelErrors(left=left, right=right, track=track)
    options = ActuationOptions(wheels=wheels, slip_v=slip, slip_omega=-slip)
    noticed = options.noticed(options.executed(Velocity(v, omega), 0.36), 0.36)
    assert noticed == pytest.approx((v, omega), abs=1e-12)


def test_unequal_wheels_turn_the_robot_as_their_speeds_say() -> None:
    options = ActuationOptions(wheels=WheelErrors(left=0.97, right=1.03, track=1.1))
    executed = options.executed(Velocity(0.3, 0.5), 0.4)
    left, right = 0.97 * (0.3 - 0.5 * 0.2), 1.03 * (0.3 + 0.5 * 0.2)
    assert executed.v == pytest.approx((left + right) / 2)
    assert executed.omega == pytest.approx((right - left) / (1.1 * 0.4))


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-4, 4), st.floats(-0.3, 0.3))
def test_a_displaced_pose_comes_back(x: float, y: float, phi: float, left: float) -> None:
    there = displaced(Pose(x, y, phi), 0.2, left)
    assert math.dist(there[:2], (x, y)) == pytest.approx(math.hypot(0.2, left))
    # Rows of the pose's own axes: forward, left.
    axes = np.array([[-math.sin(phi), math.cos(phi)], [-math.cos(phi), -math.sin(phi)]])
    assert axes @ (np.array(there[:2]) - [x, y]) == pytest.approx([0.2, left])


@pytest.mark.parametrize("seed", range(6))
def test_changes_touch_as_many_things_as_they_say(seed: int) -> None:
    scene = load_scene("hall")
    changes = Changes(removed=0.2, replaced=0.3, moved=0.25, moved_m=0.4, seed=seed)
    now, count = changed(scene, changes), len(scene.items)
    was = {item.name: item for item in scene.items}
    assert len(now.items) == count - round(0.2 * count)
    assert sum(i.look != was[i.name].look for i in now.items) == round(0.3 * count)
    moved = [i for i in now.items if i.at_m != was[i.name].at_m]
    assert len(moved) == round(0.25 * count)
    for item in moved:
        assert math.dist(item.at_m, was[item.name].at_m) == pytest.approx(0.4)
        assert not overlap(item.outline(), keep_clear(scene.arena))
    assert changed(scene, changes) == now


def test_no_changes_leave_the_scene_itself() -> None:
    scene = load_scene("hall")
    assert changed(scene, Changes()) is scene


def test_people_walk_beside_the_free_floor_at_their_pace() -> None:
    scene = load_scene("hall")
    walkers = people(scene, 4, seed=3)
    assert len({w.item.name for w in walkers}) == 4
    for walker in walkers:
        way = np.array([walker.pose(0.1 * k)[:2] for k in range(400)])
        steps = np.linalg.norm(np.diff(way, axis=0), axis=1)
        # Shorter only where they turn back.
        assert np.quantile(steps, 0.1) == pytest.approx(0.08, abs=1e-9)
        (x0, x1), (y0, y1) = scene.arena.x_m, scene.arena.y_m
        assert not ((way > [x0, y0]) & (way < [x1, y1])).all(axis=1).any()
        assert walker.item.at_m == pytest.approx(walker.pose(0.0)[:2])


def test_a_veil_lifts_the_dark_and_gain_brightens() -> None:
    image = np.zeros((60, 80), np.uint8)
    image[:, 40:] = 120
    plain = Sensor(80, 60, 0.0, 0.0, 0.0, 0)
    veiled = Sensor(80, 60, 0.0, 0.0, 0.0, 0, veil=0.4).expose(image, 0.0, 1)
    brighter = Sensor(80, 60, 0.0, 0.0, 0.0, 0, gain=1.5).expose(image, 0.0, 1)
    assert np.array_equal(plain.expose(image, 0.0, 1), image)
    assert veiled[30, 37] > 5
    assert veiled[30, 42] < 115
    assert brighter[0, -1] == 180


def test_a_shaken_image_is_that_of_the_tilted_camera() -> None:
    """A picture of rays: each pixel's grey is a smooth function of where it looks."""
    camera = load_camera("hypercatadioptric").resized(320, 240)
    pixels = np.stack(np.meshgrid(np.arange(320), np.arange(240)), axis=-1).astype(float)

    def picture(turn: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        rays, seen = camera.robot_rays(pixels)
        right, forward, up = np.moveaxis(np.where(seen[..., None], rays, 0.0) @ turn.T, -1, 0)
        grey = 128 + 60 * np.sin(9 * right + 6 * up) * np.cos(8 * forward)
        return np.where(seen, np.rint(grey), 0).astype(np.uint8)

    shake = Shake(camera, 3.0, seed=7)
    shaken = shake.tilted(picture(np.eye(3)), 5)
    assert np.array_equal(shaken, shake.tilted(picture(np.eye(3)), 5))
    pitch, roll = np.random.default_rng([7, 3, 5]).normal(0.0, math.radians(3.0), 2)
    expected = picture(Rotation.from_rotvec([pitch, roll, 0.0]).as_matrix())
    both = (shaken > 0) & (expected > 0)
    apart = [
        np.median(np.abs(shaken[both].astype(int) - p[both]))
        for p in (expected, picture(np.eye(3)))
    ]
    assert apart[0] <= 1
    assert apart[1] >= 4


class PaintedRenderer:
    """Shows the forward coordinate of the camera as one grey level."""

    def render(self, pose: Pose, height_m: float) -> np.ndarray[Any, Any]:
        return np.full((4, 4), round(100 * pose.y), np.uint8)

    def close(self) -> None:
        """Nothing to release."""


def photographed(latency: float, shutter: float) -> int:
    sensor = Sensor(4, 4, 0.0, 0.0, 0.0, 0)
    eye = Eye(PaintedRenderer(), sensor, 0.7, latency, shutter)  # type: ignore[arg-type]
    for k in range(201):
        eye.note(0.01 * k, Pose(0.0, 0.01 * k, 0.0))
    image = eye.photograph(2.0, Pose(0.0, 2.0, 0.0), moving=True).image
    assert image is not None
    return int(image[0, 0])


def test_a_late_camera_shows_the_past_and_a_slow_one_its_mean() -> None:
    assert photographed(0.0, 0.0) == 200
    assert photographed(0.3, 0.0) == pytest.approx(170, abs=1)
    assert photographed(0.0, 0.2) == pytest.approx(190, abs=1)
    assert photographed(0.4, 0.4) == pytest.approx(140, abs=1)


@pytest.fixture
def opened() -> Iterator[Any]:
    backends = []

    def build(**options: Any) -> SimBackend:
        robot = load_robot("p3dx")
        setup = BackendSetup(
            robot=robot,
            mount=robot.mount("centre"),
            camera=CAMERA,
            true_camera=CAMERA,
            start=Pose(0.0, 0.0, 0.0),
            limits=robot.operating,
            options=SimOptions.model_validate({"scene": SMALL, "image_noise": 0.0, **options}),
            seed=5,
        )
        backend = SimBackend(setup)
        backend.open()
        backends.append(backend)
        return backend

    yield build
    for backend in backends:
        backend.close()


def picture(frame: Any) -> np.ndarray[Any, Any]:
    return np.asarray(frame.image, dtype=int)


@pytest.mark.sim
def test_the_target_is_taught_in_the_scene_as_it_was(opened: Any) -> None:
    unchanged = opened()
    before = picture(unchanged.teach()[0])
    changed = opened(changes={"light": Light(brightness=0.5).model_dump(), "gain": 0.9})
    # The physics puts the robot down to a micrometre.
    assert np.abs(picture(changed.teach()[0]) - before).mean() < 0.2
    seen = picture(changed.camera.read())
    lit = before > 40
    assert np.median(seen[lit] / before[lit]) == pytest.approx(0.45, abs=0.05)


@pytest.mark.sim
def test_a_camera_beside_its_mount_stays_there(opened: Any) -> None:
    backend = opened(mount_error={"left_m": 0.1, "forward_m": 0.05})
    assert backend.truth() == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    axle = backend._opened().physics.axle()
    assert (axle.x, axle.y) == pytest.approx((0.1, -0.05), abs=1e-3)


@pytest.mark.sim
def test_scatter_moves_the_robot_and_not_its_odometry(opened: Any) -> None:
    quiet, scattered = opened(), opened(scatter=Scatter(v_m_s=0.1, omega_deg_s=10).model_dump())
    for backend in (quiet, scattered):
        for k in range(8):
            backend.base.command(Velocity(0.1, 0.0))
            backend.clock.sleep_until(0.1 * (k + 1))
    told = [backend.base.odometry().pose.y for backend in (quiet, scattered)]
    true = [backend.truth().y for backend in (quiet, scattered)]
    assert told[1] == pytest.approx(told[0], abs=0.01)
    assert abs(true[1] - true[0]) > 1e-3


def test_a_scene_without_things_can_change() -> None:
    room = {"x_m": [-3, 3], "y_m": [-5, 4], "height_m": 2.5}
    empty = Scene.model_validate({"name": "s", "room": room})
    assert changed(empty, Changes(moved=0.5, removed=0.5)).items == ()
