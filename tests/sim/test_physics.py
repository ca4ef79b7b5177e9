"""Robots in PyBullet move as their wheels say, and touch what stands in their way."""

import math

import numpy as np
import pytest

from visctrl.hal.actuation import Actuation, ActuationOptions
from visctrl.hal.errors import DeviceError
from visctrl.hal.types import Pose, Velocity
from visctrl.robots import load_robot, robot_names
from visctrl.robots.unicycle import relative_pose, step_exact
from visctrl.sim.world.engine import disconnect
from visctrl.sim.world.physics import STEPS_PER_SECOND, Physics
from visctrl.sim.world.scene import Item, Room, Scene

STEP_S = 1.0 / STEPS_PER_SECOND
POST = Item(name="post", at_m=(0.0, 1.0), size_m=(0.3, 0.3, 1.0))
SCENE = Scene(name="test", room=Room(x_m=(-6, 6), y_m=(-6, 6), height_m=2.0), items=(POST,))
EMPTY = SCENE.model_copy(update={"items": ()})
START = Pose(0.5, -2.0, 0.3)

robots = pytest.mark.parametrize("name", robot_names())


def drive(
    physics: Physics, velocity: Velocity, seconds: float, robot_name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Drive under the operating ramp; return dead reckoning and the set-points' exact integral."""
    actuation = Actuation(load_robot(robot_name).operating, ActuationOptions())
    actuation.request(0.0, velocity)
    reckoned = wanted = np.array(physics.axle())
    for k in range(round(seconds * STEPS_PER_SECOND)):
        set_point = actuation.velocity_at(k * STEP_S, STEP_S)
        physics.drive(set_point)
        physics.step()
        reckoned = step_exact(reckoned, *physics.wheel_velocity(), STEP_S)
        wanted = step_exact(wanted, *set_point, STEP_S)
    return reckoned, wanted


@robots
@pytest.mark.parametrize(
    ("v", "omega_deg"),
    [(0.3, 0.0), (-0.3, 0.0), (0.0, 40.0), (0.0, -3.0), (0.25, 20.0), (0.05, -10.0)],
    ids=["straight", "back", "turn", "slow turn", "arc", "slow arc"],
)
def test_odometry_and_commands_agree_with_the_motion(name: str, v: float, omega_deg: float) -> None:
    physics = Physics(EMPTY, load_robot(name))
    try:
        physics.put(START)
        velocity = Velocity(v, math.radians(omega_deg))
        reckoned, wanted = drive(physics, velocity, 5.0, name)
        truth = np.array(physics.axle())
        travelled = abs(v) * 4.5
        for other in (reckoned, wanted):
            x, y, phi = relative_pose(truth, other)
            assert math.hypot(x, y) < 2e-3 + 2e-3 * travelled
            # 0.2 % of the turn.
            assert abs(phi) < math.radians(0.05) + 2e-3 * abs(velocity.omega) * 5.0
        assert physics.tilt() < math.radians(0.05)
    finally:
        physics.close()


@robots
def test_a_robot_put_down_stays_where_it_is(name: str) -> None:
    physics = Physics(EMPTY, load_robot(name))
    try:
        physics.put(START)
        drive(physics, Velocity(0.0, 0.0), 2.0, name)
        assert np.allclose(physics.axle(), START, atol=2e-4)
        assert physics.contacts == 0
    finally:
        physics.close()


@robots
def test_running_into_something_counts_once_and_stops_the_robot(name: str) -> None:
    physics = Physics(SCENE, load_robot(name))
    try:
        physics.put(Pose(0.0, 0.0, 0.0))
        drive(physics, Velocity(0.3, 0.0), 5.0, name)
        assert physics.contacts >= 1
        edge = POST.at_m[1] - POST.size_m[1] / 2 - load_robot(name).body.front_m
        assert physics.axle().y < edge + 0.02
    finally:
        physics.close()


def test_a_moved_item_is_met_where_it_is() -> None:
    physics = Physics(SCENE, load_robot("p3dx"))
    try:
        physics.put(Pose(0.0, 0.0, 0.0))
        physics.move("post", Pose(2.0, 1.0, 0.0))
        drive(physics, Velocity(0.3, 0.0), 5.0, "p3dx")
        assert physics.contacts == 0
        assert physics.axle().y > 1.2
    finally:
        physics.close()


def test_a_closed_window_is_a_device_fault() -> None:
    physics = Physics(EMPTY, load_robot("p3at"))
    physics.put(START)
    disconnect(physics.client)
    with pytest.raises(DeviceError, match="window was closed"):
        physics.step()
    physics.close()


def test_walls_are_solid() -> None:
    physics = Physics(EMPTY, load_robot("p3dx"))
    try:
        physics.put(Pose(0.0, 5.0, 0.0))
        drive(physics, Velocity(0.3, 0.0), 5.0, "p3dx")
        assert physics.contacts >= 1
        assert physics.axle().y < 6.0 - load_robot("p3dx").body.front_m + 0.02
    finally:
        physics.close()
