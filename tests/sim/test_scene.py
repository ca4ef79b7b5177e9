"""Scenes: what they hold, and poses that they refuse."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pydantic import ValidationError

from visctrl.hal.errors import InputError
from visctrl.hal.types import Pose
from visctrl.robots import Robot, load_robot
from visctrl.sim.options import SimOptions
from visctrl.sim.render.surfaces import surfaces
from visctrl.sim.world.scene import Item, Room, Scene, load_scene, overlap, rectangle, robot_outline
from visctrl.sim.world.scene_files import scene_names

HALL = load_scene("hall")
P3DX = load_robot("p3dx")
MINIMAL = """
name: small
room: {x_m: [-3, 3], y_m: [-3, 3], height_m: 2.5}
"""


@pytest.mark.parametrize("robot", [load_robot(name) for name in ("p3dx", "p3at")])
def test_the_hall_leaves_room_to_manoeuvre(robot: Robot) -> None:
    wider = robot.model_copy(
        update={
            "body": robot.body.model_copy(
                update={
                    "front_m": robot.body.front_m + 0.3,
                    "rear_m": robot.body.rear_m + 0.3,
                    "width_m": robot.body.width_m + 0.6,
                }
            )
        }
    )
    for x in (-1.2, 0.0, 1.2):
        for y in np.linspace(-3.5, 0.0, 5):
            for phi in np.linspace(-math.pi, math.pi, 8, endpoint=False):
                for mount in robot.mounts.values():
                    HALL.check_clear(Pose(x, y, phi), mount.forward_m, wider, "start")


def test_the_hall_surrounds_the_robot_near_and_far() -> None:
    centres = np.array([s.side.corners.mean(axis=0) for s in surfaces(HALL)])
    items = np.array([bool(s.item) for s in surfaces(HALL)])
    for start in ((0.0, 0.0), (1.2, -3.5), (-1.2, -1.2)):
        away = centres[:, :2] - start
        distance = np.linalg.norm(away, axis=1)
        assert distance.min() < 2.5
        assert distance.max() > 11.0
        # Something nearer than the walls in every sixth of the horizon.
        sector = np.floor(np.arctan2(away[items, 1], away[items, 0]) / (np.pi / 3)).astype(int)
        assert len(set(sector.tolist())) == 6
    depths = centres[items & (centres[:, 1] > 1.5) & (np.abs(centres[:, 0]) < 3)][:, 1]
    assert np.ptp(depths) > 5.0


@pytest.mark.parametrize("item", HALL.items, ids=lambda item: item.name)
def test_a_pose_in_an_item_is_refused_by_name(item: Item) -> None:
    if item.bottom_m >= P3DX.body.height_m:
        HALL.check_clear(Pose(*item.at_m, 0.3), 0.0, P3DX, "start")
    else:
        with pytest.raises(InputError, match=rf"start .* would touch '{item.name}'"):
            HALL.check_clear(Pose(*item.at_m, 0.3), 0.0, P3DX, "start")


def test_touching_with_the_outline_alone_is_refused() -> None:
    side = P3DX.body.width_m / 2
    scene = Scene(
        name="one",
        room=Room(x_m=(-3, 3), y_m=(-3, 3), height_m=2),
        items=(Item(name="post", at_m=(1.0, 0.0), size_m=(0.2, 0.2, 1.0)),),
    )
    near, clear = 1.0 - 0.1 - side + 0.005, 1.0 - 0.1 - side - 0.005
    scene.check_clear(Pose(clear, 0.0, 0.0), 0.0, P3DX, "start")
    with pytest.raises(InputError, match="post"):
        scene.check_clear(Pose(near, 0.0, 0.0), 0.0, P3DX, "start")
    with pytest.raises(InputError, match="post"):
        # Turned, its longer side reaches out.
        scene.check_clear(Pose(clear - 0.05, 0.0, math.pi / 2), 0.0, P3DX, "start")


def test_walls_are_refused() -> None:
    with pytest.raises(InputError, match="wall of scene 'hall'"):
        HALL.check_clear(Pose(4.9, -2.0, 0.0), 0.0, P3DX, "start")


def test_the_outline_is_placed_from_the_camera() -> None:
    body = P3DX.body
    outline = robot_outline(Pose(1.0, 2.0, 0.0), 0.1, P3DX)
    assert outline[:, 1].max() == pytest.approx(2.0 - 0.1 + body.front_m)
    assert outline[:, 1].min() == pytest.approx(2.0 - 0.1 - body.rear_m)
    assert np.ptp(outline[:, 0]) == pytest.approx(body.width_m)
    turned = robot_outline(Pose(1.0, 2.0, math.pi / 2), 0.1, P3DX)
    assert turned[:, 0].min() == pytest.approx(1.0 + 0.1 - body.front_m)


boxes = st.builds(
    lambda x, y, phi, w, h: (Pose(x, y, phi), w, h),
    st.floats(-2, 2),
    st.floats(-2, 2),
    st.floats(-4, 4),
    st.floats(0.2, 2),
    st.floats(0.2, 2),
)


@given(a=boxes, b=boxes)
def test_overlap_agrees_with_points_in_both(
    a: tuple[Pose, float, float], b: tuple[Pose, float, float]
) -> None:
    grid = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 60), np.linspace(-0.5, 0.5, 60)), -1)
    pose, width, length = a
    corners = rectangle(*a)
    centre = corners.mean(axis=0)
    points = (
        centre
        + grid[..., :1] * (corners[0] - corners[1])
        + grid[..., 1:] * (corners[0] - corners[3])
    )
    local = (points - [b[0].x, b[0].y]) @ np.array(
        [
            [math.cos(b[0].phi), -math.sin(b[0].phi)],
            [math.sin(b[0].phi), math.cos(b[0].phi)],
        ]
    )
    depth = np.minimum(b[1] / 2 - np.abs(local[..., 0]), b[2] / 2 - np.abs(local[..., 1])).max()
    # Decided by sampling only where the grid is fine enough to tell.
    assume(abs(depth) > 0.05)
    assert overlap(corners, rectangle(*b)) == (depth > 0)
    assert (pose.x, pose.y) == pytest.approx(centre)
    assert min(width, length) > 0


def test_an_unknown_scene_comes_with_the_known_ones() -> None:
    assert "hall" in scene_names()
    with pytest.raises(InputError, match=r"unknown scene 'hal'.*did you mean 'hall'"):
        load_scene("hal")


def test_an_unknown_scene_is_refused_with_its_key() -> None:
    with pytest.raises(ValidationError, match=r"(?s)scene.*did you mean 'hall'"):
        SimOptions(scene="hal")


def test_a_scene_may_be_a_file_of_ones_own(tmp_path: Path) -> None:
    path = tmp_path / "small.yaml"
    path.write_text(MINIMAL)
    assert load_scene(str(path)).name == "small"
    with pytest.raises(InputError, match="no such file"):
        load_scene(str(tmp_path / "none.yaml"))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("items: [{name: a, at_m: [0, 0], size_m: [1, 1, 0]}]", r"items\.0\.size_m\.2"),
        ("items: [{name: a, at_m: [0, 0], size_m: [1, 1, 1], colour: red}]", "unknown key"),
        (
            "items: [{name: a, at_m: [0, 0], size_m: [1, 1, 1]},"
            " {name: a, at_m: [1, 1], size_m: [1, 1, 1]}]",
            "different names: a",
        ),
    ],
)
def test_wrong_scenes_are_refused(tmp_path: Path, wrong: str, message: str) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(MINIMAL + wrong)
    with pytest.raises(InputError, match=message):
        load_scene(str(path))


def test_a_room_inside_out_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(MINIMAL.replace("x_m: [-3, 3]", "x_m: [3, -3]"))
    with pytest.raises(InputError, match="low < high"):
        load_scene(str(path))


def test_surfaces_face_outwards_and_hold_their_textures() -> None:
    for surface in surfaces(HALL):
        side = surface.side
        assert np.linalg.norm(side.right) == pytest.approx(surface.pattern.width_m)
        assert np.linalg.norm(side.up) == pytest.approx(surface.pattern.height_m)
        middle = side.corners.mean(axis=0)
        if surface.item:
            item = next(i for i in HALL.items if i.name == surface.item)
            centre = np.array([*item.at_m, item.bottom_m + item.size_m[2] / 2])
            assert np.dot(middle - centre, side.normal) > 0
        else:
            assert np.dot(np.array([0.0, 2.0, 1.0]) - middle, side.normal) > 0
