"""Robots by name, by path and by entry point; what their files say of sonar and protocol."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from importlib import resources
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import yaml

from visctrl.cli.listing import _robot_line
from visctrl.hal.errors import LinkError
from visctrl.hal.pioneer.subclasses import find_subclass, known_subclasses, subclasses_of
from visctrl.robots import load_robot, model, robot_names
from visctrl.robots.errors import InputError

robots = pytest.mark.parametrize("name", robot_names())


def copied(folder: Path, robot: str = "p3dx", **changes: object) -> Path:
    """Copy a robot's folder, with other values in its file; return the folder."""
    source = resources.files("visctrl.robots") / robot
    data = yaml.safe_load((source / "robot.yaml").read_text(encoding="utf-8"))
    folder.mkdir(parents=True)
    (folder / "robot.yaml").write_text(yaml.safe_dump({**data, **changes}), encoding="utf-8")
    (folder / "robot.urdf").write_text((source / "robot.urdf").read_text(encoding="utf-8"))
    return folder


def test_a_robot_is_found_by_its_folder_and_by_its_file(tmp_path: Path) -> None:
    folder = copied(tmp_path / "mine", name="mine")
    by_folder, by_file = load_robot(str(folder)), load_robot(str(folder / "robot.yaml"))
    assert by_folder == by_file
    assert by_folder.name == "mine"
    assert by_folder.sonar == load_robot("p3dx").sonar
    assert by_folder.urdf().read_text() == load_robot("p3dx").urdf().read_text()


def test_a_folder_of_the_same_name_does_not_hide_a_built_in_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copied(tmp_path / "p3dx", name="mine")
    monkeypatch.chdir(tmp_path)
    assert load_robot("p3dx").title == "Pioneer P3-DX"
    assert load_robot("./p3dx").name == "mine"


def test_without_urdf_only_physics_is_missing(tmp_path: Path) -> None:
    folder = copied(tmp_path / "mine", name="mine")
    (folder / "robot.urdf").unlink()
    with pytest.raises(InputError, match=r"'mine': there is no robot\.urdf beside"):
        load_robot(str(folder)).urdf()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"drive": "tracked"}, "robot.yaml: key 'drive'"),
        ({"sonar": {"range_m": 5.0}}, "key 'sonar.height_m' is missing"),
        ({"arcos": {"turn_per_difference": 0.0}}, "key 'arcos.turn_per_difference'"),
        ({"wheel": 3}, "unknown key 'wheel'; known: .*did you mean 'wheels'"),
    ],
)
def test_a_file_that_cannot_be_used(tmp_path: Path, changes: dict[str, object], says: str) -> None:
    with pytest.raises(InputError, match=says):
        load_robot(str(copied(tmp_path / "mine", **changes)))


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_robot(str(tmp_path / "nowhere" / "robot.yaml"))


@pytest.fixture
def announced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """An installed package that announces a robot."""
    copied(tmp_path / "robots_of_ours" / "rover", name="rover")
    points = [EntryPoint("rover", "robots_of_ours.rover", model.GROUP)]
    points.append(EntryPoint("ghost", "robots_of_ours.ghost", model.GROUP))
    monkeypatch.setattr(model, "entry_points", lambda group: points)
    monkeypatch.syspath_prepend(tmp_path)
    caches = (model._announced, model.robot_names, model._read)
    for cache in caches:
        cache.cache_clear()
    yield "rover"
    monkeypatch.undo()
    for cache in caches:
        cache.cache_clear()
    for module in [name for name in sys.modules if name.startswith("robots_of_ours")]:
        del sys.modules[module]


def test_an_installed_package_announces_robots(announced: str) -> None:
    assert {"rover", "ghost", "p3dx"} <= set(robot_names())
    assert load_robot(announced).name == "rover"
    with pytest.raises(InputError, match=r"robot 'ghost': package robots_of_ours\.ghost cannot"):
        load_robot("ghost")
    known_subclasses.cache_clear()
    try:
        assert "p3at-sh" in known_subclasses(), "a broken package hides nobody else's robots"
    finally:
        known_subclasses.cache_clear()
    assert "cannot be used" in _robot_line("ghost")
    assert _robot_line("p3dx") == "Pioneer P3-DX"


@robots
def test_sonar_rings_are_the_same_on_both_sides(name: str) -> None:
    ring = load_robot(name).sonar
    if ring is None:
        return
    places = [(t.forward_m, t.left_m) for t in ring.transducers.values()]
    for x, y in places:  # one of the AmigoBot's is 5 mm off in its parameter file
        assert min(math.dist((x, -y), other) for other in places) < 0.006
    for each in ring.transducers.values():
        assert abs(each.direction_deg) <= 180.0
        assert each.left_m * each.direction_deg > 0, "each looks away from the middle"


@robots
def test_protocol_and_wheels_say_the_same_of_turning(name: str) -> None:
    robot = load_robot(name)
    if robot.arcos is None:
        return
    # ω = (right - left)/2 · DiffConv, in rad/s per mm/s, is ω = (right - left)/track.
    assert robot.wheels.effective_track_m == pytest.approx(
        2e-3 / robot.arcos.turn_per_difference, rel=2e-3
    )
    assert robot.hardware.v_m_s * 1e3 <= robot.arcos.flash.speed_top
    assert robot.hardware.omega_deg_s <= robot.arcos.flash.turn_top


def test_controllers_are_known_whatever_the_case_of_their_names() -> None:
    assert find_subclass("P3DX-SH").robot == load_robot("p3dx")
    assert find_subclass("p2at").units.distance_mm == 1.32
    names = [name for robot in robot_names() for name in subclasses_of(load_robot(robot))]
    assert len(names) == len(set(names)) == len(known_subclasses()), "no name twice"
    with pytest.raises(LinkError, match=r"calls itself 'p3dy-sh'.*did you mean 'p3dx-sh'"):
        find_subclass("p3dy-sh")


def test_a_robot_of_the_users_own_is_looked_at_first(tmp_path: Path) -> None:
    mine = load_robot(str(copied(tmp_path / "mine", name="mine")))
    assert find_subclass("p3dx-sh", [mine]).robot == mine
