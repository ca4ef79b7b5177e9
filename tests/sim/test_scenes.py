"""Every scene that can be named: free where the robot drives, and the same each time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visctrl.hal.errors import InputError
from visctrl.hal.types import Pose
from visctrl.robots import load_robot
from visctrl.sim.render import photographs
from visctrl.sim.render.reliefs import PERIODS_M, Kind, relief
from visctrl.sim.render.surfaces import surfaces
from visctrl.sim.world.light import Light
from visctrl.sim.world.random_scene import random_scene
from visctrl.sim.world.scene import Scene, keep_clear, load_scene, overlap
from visctrl.sim.world.scene_files import check_scene_name, scene_names

ROOM = {"x_m": [-3, 3], "y_m": [-5, 4], "height_m": 2.5}


def test_there_are_many_scenes() -> None:
    assert len(scene_names()) >= 13


@pytest.mark.parametrize("name", scene_names())
def test_the_robot_fits_where_it_is_to_drive(name: str) -> None:
    scene, robot = load_scene(name), load_robot("p3dx")
    arena = scene.arena
    for x in np.linspace(*arena.x_m, 4):
        for y in np.linspace(arena.y_m[0], -0.8, 4):
            scene.check_clear(Pose(float(x), float(y), 0.3), 0.0, robot, "a start")
    for phi in np.radians([-180, -90, 0, 90]):
        scene.check_clear(Pose(0.0, 0.0, float(phi)), 0.0, robot, "target")


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6))
def test_a_random_scene_is_free_where_the_robot_drives(seed: int) -> None:
    scene = random_scene(seed)
    assert scene == load_scene(f"random:{seed}")
    free = keep_clear(scene.arena)
    assert not any(overlap(free, item.outline()) for item in scene.items if item.bottom_m == 0.0)


def test_random_scenes_differ() -> None:
    assert len({random_scene(seed).room.x_m for seed in range(20)}) == 20


@pytest.mark.parametrize("name", ["random:", "random:x", "random:-1", "random:1.5"])
def test_a_random_scene_needs_a_seed(name: str) -> None:
    with pytest.raises(InputError, match="whole number"):
        check_scene_name(name)


def test_a_row_is_written_out_and_its_items_look_alike() -> None:
    row = {"name": "pillar", "at_m": [1, 0], "size_m": [0.4, 0.4, 2], "count": 3, "step_m": [0, 2]}
    scene = Scene.model_validate({"name": "s", "room": ROOM, "items": [row]})
    assert [item.at_m for item in scene.items] == [(1, 0), (1, 2), (1, 4)]
    assert len({item.name for item in scene.items}) == 3
    fronts = [s.pattern for s in surfaces(scene) if s.name.endswith("front") and s.item]
    assert fronts[0] == fronts[1] == fronts[2]


def test_a_row_without_a_step_is_refused() -> None:
    row = {"name": "pillar", "at_m": [1, 0], "size_m": [0.4, 0.4, 2], "count": 3}
    with pytest.raises(ValueError, match="step_m"):
        Scene.model_validate({"name": "s", "room": ROOM, "items": [row]})


@settings(max_examples=30, deadline=None)
@given(st.floats(0.0, 0.9), st.floats(-180.0, 180.0))
def test_light_from_one_side_is_brightest_there(side: float, bearing: float) -> None:
    light = Light(side=side, from_deg=bearing)
    towards = np.array([math.sin(math.radians(bearing)), math.cos(math.radians(bearing)), 0.0])
    assert light.gain(towards, "a") >= 1.0 >= light.gain(-towards, "a")
    assert light.gain(towards, "a") - 1.0 == pytest.approx(1.0 - light.gain(-towards, "a"))


def test_even_light_changes_nothing() -> None:
    assert Light().gain(np.array([1.0, 0.0, 0.0]), "a") == 1.0


@pytest.mark.parametrize("kind", PERIODS_M)
def test_a_floor_pattern_repeats_itself_after_its_period(kind: Kind) -> None:
    density = 40.0 / PERIODS_M[kind]
    picture = relief(kind, np.random.default_rng(0), 160, 120, density)
    assert np.array_equal(picture[:, :80], picture[:, 80:])
    assert np.array_equal(picture[:80], picture[40:])


@pytest.mark.parametrize("kind", ["bricks", "boards", "windows", "shelves", "photo", "tiles"])
def test_a_relief_has_the_size_asked_for_and_contrast(kind: Kind) -> None:
    picture = relief(kind, np.random.default_rng(1), 601, 403, 128.0)
    assert picture.shape == (403, 601)
    assert picture.dtype == np.float32
    assert np.isfinite(picture).all()
    assert picture.std() > 0.2


def test_without_photographs_the_message_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(photographs, "_PACKAGE", "not_installed_here")
    photographs._read.cache_clear()
    with pytest.raises(InputError, match=r"pip install 'visctrl\[scenes\]'"):
        photographs.photograph(1)
