"""The robot from above, and the video that shows it beside the camera's image."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from visctrl.hal.types import Pose
from visctrl.robots import load_robot
from visctrl.runtime.config import load_scenario, parse_setting
from visctrl.runtime.plan import make_plan
from visctrl.runtime.registry import REGISTRIES
from visctrl.viewers.report.topview import Outline
from visctrl.viewers.run_pictures import run_with_pictures
from visctrl.viewers.video.overhead import draw_overhead


def outline() -> Outline:
    robot = load_robot("p3dx")
    return Outline.of(robot, robot.mount("centre"))


def coloured(picture: np.ndarray, channel: int) -> np.ndarray:
    """Return (row, column) of pixels in which a channel (blue 0, red 2) stands out."""
    values = picture.astype(int)
    return np.argwhere(values[..., channel] - values[..., 2 - channel] > 90)


def test_the_robot_is_drawn_where_it_is_and_the_target_above_it() -> None:
    path = [Pose(0.0, y, 0.0) for y in np.linspace(-2.0, -1.0, 20)]
    picture = draw_overhead((400, 400), path, path[-1], Pose(0.0, 0.0, 0.0), outline())
    red, blue = coloured(picture, 2), coloured(picture, 0)
    assert red[:, 0].min() < blue[:, 0].min(), "the target lies ahead: further up"
    assert abs(np.median(blue[:, 1]) - 200) <= 2, "in the middle"
    turned = draw_overhead((400, 400), path, Pose(1.5, -1.0, math.pi / 2), None, outline())
    assert np.median(coloured(turned, 2)[:, 1]) > 220, "x is to the right"


@pytest.mark.parametrize("robot", [Pose(math.nan, 0.0, 0.0), Pose(0.0, 0.0, 0.0)])
def test_a_robot_that_is_nowhere_can_be_drawn(robot: Pose) -> None:
    picture = draw_overhead((120, 90), [], robot, None, outline())
    assert picture.shape == (90, 120, 3)


def test_a_video_shows_image_tracks_and_top_view_tick_by_tick(tmp_path: Path) -> None:
    settings = ("backend=mock", "mock.noise_px=0.3", "duration_s=1.5", "camera.width=404")
    overrides = [parse_setting(text) for text in settings]
    plan = make_plan(load_scenario("default", overrides, REGISTRIES.backends.names()))
    outcome = run_with_pictures(plan, tmp_path, video=True)
    video = cv2.VideoCapture(str(tmp_path / "video.mp4"))
    pictures = []
    while (read := video.read())[0]:
        pictures.append(read[1])
    assert len(pictures) == outcome.summary["ticks"]
    width, height = plan.camera.width, plan.camera.height
    assert pictures[-1].shape == (height // 2 * 2, (width + height) // 2 * 2, 3), "even sizes"
    left, right = pictures[-1][:, :width], pictures[-1][:, width:]
    assert left.mean() < 80, "features on a dark canvas"
    assert right.mean() > 180, "the light top view"
    assert len(coloured(left, 2)) > 10, "orange tracks: nothing else there is red"
    assert len(coloured(right, 2)) > 50, "the robot"
