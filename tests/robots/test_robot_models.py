"""Each robot's URDF says the same as its ``robot.yaml``."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from visctrl.robots import load_robot, robot_names
from visctrl.robots.errors import InputError

robots = pytest.mark.parametrize("name", robot_names())


def urdf(name: str) -> ET.Element:
    return ET.fromstring(load_robot(name).urdf().read_text(encoding="utf-8"))


def numbers(element: ET.Element | None, key: str) -> np.ndarray:
    assert element is not None
    return np.array([float(word) for word in element.attrib[key].split()])


def joint_places(name: str) -> dict[str, np.ndarray]:
    joints = urdf(name).findall("joint")
    return {joint.attrib["name"]: numbers(joint.find("origin"), "xyz") for joint in joints}


def test_the_robots_are_there() -> None:
    own = {"amigobot", "p3at", "p3dx", "patrolbot", "peoplebot", "powerbot"}
    assert own <= set(robot_names())


@robots
def test_masses_add_up(name: str) -> None:
    masses = [float(m.attrib["value"]) for m in urdf(name).findall(".//inertial/mass")]
    assert sum(masses) == pytest.approx(load_robot(name).body.mass_kg)


@robots
def test_inertias_are_those_of_bodies(name: str) -> None:
    for element in urdf(name).findall(".//inertia"):
        value = {key: float(text) for key, text in element.attrib.items()}
        matrix = np.array(
            [
                [value["ixx"], value["ixy"], value["ixz"]],
                [value["ixy"], value["iyy"], value["iyz"]],
                [value["ixz"], value["iyz"], value["izz"]],
            ]
        )
        a, b, c = np.sort(np.linalg.eigvalsh(matrix))
        assert a > 0
        assert a + b >= c * (1 - 1e-9)


@robots
def test_the_outline_is_the_one_described(name: str) -> None:
    body = load_robot(name).body
    base = urdf(name).find("link[@name='base_link']/collision")
    assert base is not None
    length, width, height = numbers(base.find("geometry/box"), "size")
    x, _, z = numbers(base.find("origin"), "xyz")
    assert (x + length / 2, length / 2 - x) == pytest.approx((body.front_m, body.rear_m))
    assert width == pytest.approx(body.width_m)
    assert z + height / 2 == pytest.approx(body.height_m)


@robots
def test_wheels_have_their_radius_and_stand_on_the_floor(name: str) -> None:
    robot, places = load_robot(name), joint_places(name)
    tree = urdf(name)
    for joint in robot.wheels.joints_left + robot.wheels.joints_right:
        sphere = tree.find(f"link[@name='{joint}_link']/collision/geometry/sphere")
        assert sphere is not None
        assert float(sphere.attrib["radius"]) == robot.wheels.radius_m
        assert places[joint][2] == pytest.approx(robot.wheels.radius_m)
    assert all(places[joint][1] > 0 for joint in robot.wheels.joints_left)
    assert all(places[joint][1] < 0 for joint in robot.wheels.joints_right)


def test_p3dx_rolls_on_the_track_that_its_odometry_assumes() -> None:
    left, right = (joint_places("p3dx")[f"{side}_wheel"] for side in ("left", "right"))
    assert left[1] - right[1] == pytest.approx(load_robot("p3dx").wheels.effective_track_m)


def test_p3at_skids_on_the_track_that_its_odometry_assumes() -> None:
    # Four tyres that resist slip alike in all directions: t + 4 a²/t, with wheelbase 2a.
    x, y, _ = joint_places("p3at")["front_left_wheel"]
    track = 2 * y
    assert track == pytest.approx(load_robot("p3at").wheels.track_m)
    effective = load_robot("p3at").wheels.effective_track_m
    assert track + 4 * x**2 / track == pytest.approx(effective, rel=2e-3)


@robots
def test_operating_limits_are_within_the_hardwares(name: str) -> None:
    robot = load_robot(name)
    for key, value in robot.operating.model_dump(exclude_none=True).items():
        assert value <= getattr(robot.hardware, key)


def test_unknown_names_come_with_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"unknown robot 'p3d'.*known: amigobot, p3at, p3dx"):
        load_robot("p3d")
    with pytest.raises(InputError, match=r"no camera mount 'mast'.*known: centre, front"):
        load_robot("p3dx").mount("mast")
