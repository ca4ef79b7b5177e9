"""Where there is no PyBullet only the simulation is missing, and it says what to install."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from visctrl.hal.errors import InputError
from visctrl.sim.render import renderer_choice
from visctrl.sim.world import engine

ROOT = Path(__file__).parents[2]


def without_pybullet(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the program in a process in which PyBullet cannot be imported."""
    code = (
        "import sys\n"
        "sys.modules['pybullet'] = None\n"
        f"sys.path.insert(0, {str(ROOT)!r})\n"
        f"sys.argv = ['visctrl', *{list(arguments)!r}]\n"
        "from visctrl.__main__ import main\n"
        "main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False
    )
    assert "Traceback" not in done.stderr
    return done


@pytest.mark.parametrize("arguments", [["run", "mock", "--quiet"], ["doctor", "--quick"]])
def test_what_needs_no_physics_works(tmp_path: Path, arguments: list[str]) -> None:
    done = without_pybullet(tmp_path, *arguments)
    assert done.returncode == 0, done.stderr


def test_the_simulation_names_the_command_that_installs_it(tmp_path: Path) -> None:
    done = without_pybullet(tmp_path, "run", "--backend", "sim", "--quiet")
    assert done.returncode == 2
    assert "the simulation needs PyBullet, which is not installed: pip install" in done.stderr


@pytest.mark.parametrize(
    ("python", "says"),
    [
        ((3, 11), "pip install pybullet;"),
        ((3, 12), "pip install pybullet-arm64;"),
        ((3, 13), "pip install pybullet-arm64;"),
        ((3, 14), "pip install pybullet (for Python 3.14 it must be compiled"),
    ],
)
def test_the_command_is_the_one_for_this_python(
    monkeypatch: pytest.MonkeyPatch, python: tuple[int, int], says: str
) -> None:
    monkeypatch.setattr(engine, "pybullet", engine._Absent())
    monkeypatch.setattr(sys, "version_info", (*python, 0, "final", 0))
    with pytest.raises(InputError) as caught:
        engine.connect()
    monkeypatch.undo()
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("arrays", "problem", "name", "says"),
    [
        (True, "no driver", "tiny", ""),
        (False, "", "gl", "renderer: gl, because PyBullet was built without NumPy"),
        (False, "no driver", "tiny", "renderer: tiny, slowly: PyBullet was built without NumPy"),
    ],
)
def test_the_default_renderer_where_pixels_come_one_by_one(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arrays: bool,
    problem: str,
    name: str,
    says: str,
) -> None:
    monkeypatch.setattr(renderer_choice, "hands_over_arrays", lambda: arrays)
    monkeypatch.setattr(renderer_choice, "gl_problem", lambda: problem)
    renderer_choice._default.cache_clear()
    try:
        assert renderer_choice.choose_drawer(None) == name
    finally:
        renderer_choice._default.cache_clear()
    assert says in capsys.readouterr().err
