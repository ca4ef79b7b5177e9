"""What the emulated robot hears and touches in a scene, and its streamed camera."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visctrl.hal.cameras.capture import CaptureCamera, CaptureOptions
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.clock import WallClock
from visctrl.hal.errors import CameraError, InputError, StaleFrameError
from visctrl.hal.types import Pose
from visctrl.robots import load_robot
from visctrl.robots.sonar import Transducer
from visctrl.sim.emulated_camera import CameraSpec, EmulatedCamera, State
from visctrl.sim.world.scene import Item, Room, Scene, load_scene
from visctrl.sim.world.scene_world import SceneWorld

HALL = load_scene("hall")
ROBOT = load_robot("p3dx")
assert ROBOT.sonar is not None
RING = tuple(ROBOT.sonar.transducers.values())
AHEAD = Transducer(0.0, 0.0, 0.0)


def scene(*items: Item) -> Scene:
    return Scene(name="box", room=Room(x_m=(-2.0, 3.0), y_m=(-1.0, 4.0), height_m=3.0), items=items)


@pytest.mark.parametrize(
    ("phi", "distance"), [(0.0, 4.0), (math.pi / 2, 2.0), (-math.pi / 2, 3.0), (math.pi, 1.0)]
)
def test_walls_are_heard_at_their_distance(phi: float, distance: float) -> None:
    world = SceneWorld(scene(), ROBOT)
    assert world.sonar(Pose(0.0, 0.0, phi), AHEAD) == pytest.approx(distance)


def test_nothing_within_range() -> None:
    big = Scene(name="big", room=Room(x_m=(-20, 20), y_m=(-20, 20), height_m=3.0))
    assert SceneWorld(big, ROBOT).sonar(Pose(0, 0, 0), AHEAD) == 20.0


def test_items_on_the_floor_are_heard_and_hanging_ones_are_not() -> None:
    box = Item(name="box", at_m=(0.0, 2.0), size_m=(0.5, 0.4, 0.5))
    picture = Item(name="picture", at_m=(0.0, 1.0), size_m=(0.5, 0.1, 0.5), bottom_m=1.0)
    world = SceneWorld(scene(box, picture), ROBOT)
    assert world.sonar(Pose(0.0, 0.0, 0.0), AHEAD) == pytest.approx(1.8)


@given(
    st.floats(HALL.room.x_m[0], HALL.room.x_m[1]),
    st.floats(HALL.room.y_m[0], HALL.room.y_m[1]),
    st.floats(-math.pi, math.pi),
    st.sampled_from(RING),
)
@settings(max_examples=60, deadline=None)
def test_nothing_is_nearer_than_the_echo(
    x: float, y: float, phi: float, transducer: Transducer
) -> None:
    """A march along the axis in steps meets nothing before the echo's range."""
    world = SceneWorld(HALL, ROBOT)
    pose = Pose(x, y, phi)
    heard = world.sonar(pose, transducer)
    forward, left = transducer.forward_m, transducer.left_m
    start = np.array([
        x - math.sin(phi) * forward - math.cos(phi) * left,
        y + math.cos(phi) * forward - math.sin(phi) * left,
    ])  # fmt: skip
    if contains(start):
        return  # inside an item
    angle = phi + transducer.direction_rad
    direction = np.array([-math.sin(angle), math.cos(angle)])
    for distance in np.arange(0.0, heard - 0.01, 0.02):
        assert not contains(start + distance * direction)


def contains(point: np.ndarray) -> bool:
    """Whether a point lies outside the room or inside something solid, by its own axes."""
    (x0, x1), (y0, y1) = HALL.room.x_m, HALL.room.y_m
    if not (x0 <= point[0] <= x1 and y0 <= point[1] <= y1):
        return True
    for item in HALL.items:
        if item.bottom_m >= 0.2:
            continue
        yaw = math.radians(item.yaw_deg)
        dx, dy = point - np.array(item.at_m)
        across = math.cos(yaw) * dx + math.sin(yaw) * dy
        along = -math.sin(yaw) * dx + math.cos(yaw) * dy
        if abs(across) < item.size_m[0] / 2 - 1e-6 and abs(along) < item.size_m[1] / 2 - 1e-6:
            return True
    return False


@given(
    st.floats(HALL.room.x_m[0] - 1, HALL.room.x_m[1] + 1),
    st.floats(HALL.room.y_m[0] - 1, HALL.room.y_m[1] + 1),
    st.floats(-math.pi, math.pi),
)
@settings(max_examples=150, deadline=None)
def test_blocked_where_the_scene_refuses_a_robot(x: float, y: float, phi: float) -> None:
    pose = Pose(x, y, phi)
    try:
        HALL.check_clear(pose, 0.0, ROBOT, "here")
        free = True
    except InputError:
        free = False
    assert SceneWorld(HALL, ROBOT).blocked(pose) is not free


@pytest.mark.sim
@pytest.mark.realtime
def test_streamed_camera() -> None:
    """It sees what the robot's pose shows, freezes, drops, and ends with its owner."""
    model = load_camera("perspective").resized(160, 120)
    spec = CameraSpec("hall", model, ROBOT.mount("centre"), fps=20.0)
    with EmulatedCamera(spec, Pose(0.0, 0.0, 0.0)) as emulated:
        camera = CaptureCamera(
            model, CaptureOptions(source=emulated.url, max_age_s=1.0), WallClock()
        )
        camera.open()
        try:
            here = picture(camera)
            noise = np.abs(picture(camera) - here).mean()
            emulated.move(Pose(0.0, 0.0, 0.5))
            time.sleep(0.5)
            assert np.abs(picture(camera) - here).mean() > 3.0 * noise
            emulated.move(Pose(0.0, 0.0, 0.0))
            time.sleep(0.5)
            assert np.abs(picture(camera) - here).mean() < 1.5 * noise
            emulated.become(State.DROPPED)
            with pytest.raises(StaleFrameError):
                read_for(camera, 2.5)
            emulated.become(State.WORKING)
        finally:
            camera.close()
        assert emulated.alive
    assert not emulated.alive


@pytest.mark.sim
def test_camera_that_cannot_start_says_why() -> None:
    model = load_camera("perspective")
    spec = CameraSpec("no-such-scene", model, ROBOT.mount("centre"))
    with pytest.raises(InputError, match="no-such-scene"), EmulatedCamera(spec, Pose(0, 0, 0)):
        pass


def picture(camera: CaptureCamera) -> np.ndarray:
    """The next picture, as floats."""
    last = camera.read().sequence
    deadline = time.monotonic() + 3.0
    while (frame := camera.read()).sequence == last:
        if time.monotonic() > deadline:
            raise CameraError("no new picture")
        time.sleep(0.01)
    return np.asarray(frame.image, dtype=np.float64)


def read_for(camera: CaptureCamera, seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        camera.read()
        time.sleep(0.02)
