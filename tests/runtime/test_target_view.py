"""A target view that another robot took, or this one with its camera elsewhere."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from visctrl.hal.cameras.catalogue import load_camera
from visctrl.robots import load_robot
from visctrl.robots.errors import InputError
from visctrl.robots.model import Mount
from visctrl.runtime.config import load_scenario, parse_setting
from visctrl.runtime.plan import Plan, make_plan
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.schemes import schemes
from visctrl.runtime.target_view import TargetView, load_target

CAMERA = load_camera("hypercatadioptric").resized(80, 60)
#: What a camera 5 cm higher does to each scheme was measured in the rendered hall: see docs.
NEED_HEIGHT = {"epipolar", "trifocal2d"}


@pytest.fixture
def taught(tmp_path: Path) -> Path:
    """A view taken by a P3-AT, whose mast is 5 cm higher than a P3-DX's."""
    mount = load_robot("p3at").mount("centre")
    path = tmp_path / "target.npz"
    TargetView(np.zeros((1, 60, 80), np.uint8), CAMERA, robot="p3at", mount=mount).save(path)
    return path


def plan_with(path: Path, *settings: str) -> Plan:
    size = ("camera.width=80", "camera.height=60")
    texts = ("backend=sim", f"target.file={path}", *size, *settings)
    overrides = [parse_setting(text) for text in texts]
    return make_plan(load_scenario("default", overrides, REGISTRIES.backends.names()))


def test_the_mount_survives_the_file(taught: Path) -> None:
    assert load_target(taught).mount == Mount(forward_m=0.0, height_m=0.8)


def test_schemes_that_use_azimuths_are_warned_and_others_refused(taught: Path) -> None:
    assert {name for name, scheme in schemes().items() if scheme.same_height} == NEED_HEIGHT
    for scheme in schemes():
        settings = (f"scheme={scheme}", "camera.mount=centre")
        if scheme in NEED_HEIGHT:
            with pytest.raises(
                InputError, match=r"'p3at', its camera 0\.8 m.*on 'p3dx' it is 0\.7"
            ):
                plan_with(taught, *settings)
        else:
            (note,) = plan_with(taught, *settings).notes
            assert "its camera 0.8 m above the floor; on 'p3dx' it is 0.75 m" in note


def test_the_same_mount_on_another_robot_is_no_matter(tmp_path: Path) -> None:
    mount = load_robot("p3dx").mount("centre")
    path = tmp_path / "target.npz"
    TargetView(np.zeros((1, 60, 80), np.uint8), CAMERA, robot="rover", mount=mount).save(path)
    assert plan_with(path).notes == ()


def test_a_camera_further_ahead_arrives_with_the_robot_further_behind(tmp_path: Path) -> None:
    mount = load_robot("p3dx").mount("centre")
    path = tmp_path / "target.npz"
    TargetView(np.zeros((1, 60, 80), np.uint8), CAMERA, robot="p3dx", mount=mount).save(path)
    (note,) = plan_with(path, "scheme=pose").notes
    assert "on 'p3dx' it is 0.1 m: the camera will be where it was, the robot 0.1 m behind" in note


def test_a_view_that_does_not_say_is_taken_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "target.npz"
    TargetView(np.zeros((1, 60, 80), np.uint8), CAMERA, robot="p3at").save(path)
    assert load_target(path).mount is None
    assert plan_with(path, "scheme=epipolar").notes == ()


@pytest.mark.parametrize("height", [-1.0, 0.0, math.nan])
def test_a_file_with_an_impossible_mount(tmp_path: Path, height: float) -> None:
    path = tmp_path / "target.npz"
    impossible = Mount.model_construct(forward_m=0.0, height_m=height)
    TargetView(np.zeros((1, 60, 80), np.uint8), CAMERA, mount=impossible).save(path)
    with pytest.raises(InputError, match=r"target\.npz"):
        load_target(path)
