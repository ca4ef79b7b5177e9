"""Round obstacles: intermediate goals that are clear, and whole runs that never touch."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pose_loop import NOISE, drive
from pose_world import World

from hal.types import Pose, Range
from visctrl.control.avoidance import EchoedObstacles, Obstacle, way_round
from visctrl.control.paths import path_between


@pytest.mark.parametrize("x", [-0.4, -0.05, 0.3])
def test_the_way_round_keeps_its_clearance_on_both_parts(x: float) -> None:
    obstacle, here, goal = Obstacle(x, -1.8, 0.29), (-0.3, -3.4), (0.0, 0.0)
    between = way_round(here, goal, [obstacle], 0.6, 0.5)
    assert between is not None
    for start, end in ((here, between), (between, goal)):
        assert obstacle.distance(path_between(start, end, 0.5).points()).min() >= 0.6


def test_no_way_round_is_said() -> None:
    wall = [Obstacle(x, -1.8, 0.3) for x in np.arange(-8.0, 8.0, 0.5)]
    assert way_round((-0.3, -3.4), (0.0, 0.0), wall, 0.6, 0.5) is None


def test_an_echo_lies_where_the_sensor_looked() -> None:
    source = EchoedObstacles(2.0, camera_forward=0.1)
    here = Pose(1.0, -3.0, math.pi / 2)
    # Ahead of this robot is −x; its right is +y.
    (found,) = source.noticed(here, [Range(0.0, 0.2, 0.0, 1.0), Range(0.1, 0.0, 1.0, math.inf)])
    assert (found.x, found.y) == pytest.approx((1.0 - 0.1 - 1.0 - 0.1, -3.0))


@pytest.mark.parametrize(
    ("start", "obstacle"),
    [((-6, -16, -20), (-1.9, -9.0, 0.5)), ((-0.3, -3.6, 0), (-0.05, -1.8, 0.29))],
)
def test_a_listed_obstacle_is_passed_and_the_target_reached(
    start: tuple[float, float, float], obstacle: tuple[float, float, float]
) -> None:
    x, y, radius = obstacle
    listed = {"x_m": x, "y_m": y, "radius_m": radius, "noticed_m": 1.5}
    world = World(start, 3, target_frames=10, noise=NOISE, offset=0.1)
    run = drive(world, tau=60.0, control={"obstacles": [listed], "clearance_m": 0.6})
    assert run.finished
    assert np.all(np.abs(run.error) < [2.0, 2.0, 1.0])
    away = np.hypot(*(np.array(run.path)[:, :2] - [x, y]).T) - radius
    assert away.min() > 0.45
