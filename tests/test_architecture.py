"""Who may import whom, what stays unimported, and what is shipped."""

from __future__ import annotations

import ast
import subprocess
import sys
from importlib import resources
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: Each room may import itself and the rooms to its left.
ROOMS = ("robots", "hal", "sim", "visctrl")
#: The rooms below `visctrl`, likewise. Providers of obstacles know the poses that are estimated.
INNER_ROOMS = (
    *("contracts", "geometry", "perception", "planning", "schemes", "planning/providers"),
    *("runtime", "calibration", "viewers", "studies", "reproduce", "api", "cli"),
)
#: Folders of the repository that are installed below `visctrl`.
LINKED = ("robots", "hal", "sim", "configs")
HEAVY = ("cv2", "pybullet", "scipy", "matplotlib", "filterpy")


def sources(room: str) -> list[Path]:
    """Return the files of a folder; those of linked folders belong to the folders themselves."""
    return sorted(
        path
        for path in (ROOT / room).rglob("*.py")
        if not any(parent.is_symlink() for parent in path.parents)
    )


def modules_imported(path: Path) -> set[str]:
    """Return the full names that a file imports, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return found


def imports_of(path: Path) -> set[str]:
    """Return the packages that a file imports, anywhere in it.

    Those of the rooms are called by the room: `visctrl.hal.clock` counts as ``hal``.
    """
    found = set()
    for name in modules_imported(path):
        top, *below = name.split(".")
        linked = top == "visctrl" and below and below[0] in LINKED
        found.add(below[0] if linked else top)
    return found


@pytest.mark.parametrize("room", ROOMS)
def test_imports_point_one_way(room: str) -> None:
    forbidden = set(ROOMS[ROOMS.index(room) + 1 :])
    if room == "visctrl":
        forbidden = set()
    files = sources(room)
    assert files
    for path in files:
        wrong = imports_of(path) & forbidden
        assert not wrong, f"{path.relative_to(ROOT)} imports {', '.join(sorted(wrong))}"


def inner_room(names: tuple[str, ...]) -> str | None:
    """Return the inner room that a module or file below `visctrl` belongs to, None if to none."""
    fitting = [room for room in INNER_ROOMS if names[: room.count("/") + 1] == (*room.split("/"),)]
    return max(fitting, key=len, default=None)


def test_imports_inside_point_one_way() -> None:
    found = set()
    for path in sources("visctrl"):
        names = path.relative_to(ROOT / "visctrl").with_suffix("").parts
        here = inner_room(names)
        if here is None:
            assert len(names) == 1, f"{path.relative_to(ROOT)} lies in no room"
            continue
        found.add(here)
        allowed = INNER_ROOMS[: INNER_ROOMS.index(here) + 1]
        for imported in modules_imported(path):
            there = inner_room(tuple(imported.split(".")[1:]))
            wrong = there is not None and there not in allowed
            assert not wrong, f"{path.relative_to(ROOT)} imports {imported}"
    assert found == set(INNER_ROOMS)


def test_a_scenario_is_read_without_what_runs_it() -> None:
    config = ROOT / "visctrl" / "runtime" / "config.py"
    assert not [name for name in modules_imported(config) if "runtime" in name]


@pytest.mark.parametrize(
    ("room", "package"),
    [
        ("robots", "cv2"),
        ("robots", "pybullet"),
        ("hal", "pybullet"),
        ("visctrl", "pybullet"),
        ("visctrl", "serial"),
        ("visctrl/runtime", "sim"),
        ("visctrl/perception", "sim"),
        ("visctrl/schemes", "sim"),
        ("visctrl/planning", "sim"),
    ],
)
def test_rooms_leave_to_others_what_is_theirs(room: str, package: str) -> None:
    """Physics lives in sim, the serial port in hal; a run reaches a backend by its name."""
    for path in sources(room):
        assert package not in imports_of(path), f"{path.relative_to(ROOT)} imports {package}"


def test_the_simulation_knows_no_driver() -> None:
    for path in sources("sim"):
        text = path.read_text(encoding="utf-8")
        assert "visctrl.hal.pioneer" not in text, f"{path.relative_to(ROOT)} names the driver"


def test_only_the_runtime_looks_at_the_wall_clock() -> None:
    for folder in ("geometry", "perception", "schemes", "planning"):
        for path in sources(f"visctrl/{folder}"):
            assert "time" not in imports_of(path), f"{path.relative_to(ROOT)} imports time"


@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"], ["--version"]])
def test_help_imports_nothing_heavy(arguments: list[str]) -> None:
    code = (
        "import sys\n"
        f"sys.argv = ['visctrl', *{arguments!r}]\n"
        "from visctrl.cli.main import main\n"
        "try:\n    main()\n"
        "except SystemExit as end:\n    assert not end.code, end.code\n"
        f"loaded = [name for name in {HEAVY!r} if name in sys.modules]\n"
        "assert not loaded, loaded\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_options_of_every_backend_come_without_heavy_imports() -> None:
    code = (
        "import sys\n"
        "from visctrl.runtime.registry import REGISTRIES\n"
        "for name in ('mock', 'sim'):\n    REGISTRIES.backend_options(name)()\n"
        f"loaded = [name for name in {HEAVY!r} if name in sys.modules]\n"
        "assert not loaded, loaded\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_package_data_is_found() -> None:
    from visctrl.hal.cameras.catalogue import camera_names, load_camera
    from visctrl.robots import load_robot, robot_names
    from visctrl.runtime.config import DEFAULT_SCENARIO, scenario_names

    assert {"p3dx", "p3at"} <= set(robot_names())
    assert {"perspective", "hypercatadioptric", "paracatadioptric", "fisheye"} <= set(
        camera_names()
    )
    assert DEFAULT_SCENARIO in scenario_names()
    for name in robot_names():
        assert load_robot(name).name == name
        assert "<robot" in load_robot(name).urdf().read_text()
    for name in camera_names():
        assert load_camera(name).name == name
    scenes = [f.name for f in (resources.files("visctrl.sim") / "scenes").iterdir()]
    assert any(name.endswith(".yaml") for name in scenes)


def test_files_are_short() -> None:
    for room in ROOMS:
        for path in sources(room):
            lines = len(path.read_text(encoding="utf-8").splitlines())
            assert lines <= 400, f"{path.relative_to(ROOT)} has {lines} lines"
