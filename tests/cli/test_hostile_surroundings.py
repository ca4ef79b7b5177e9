"""Whatever the surroundings do: streams, folders and packages that are gone, an early Ctrl-C."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_hostile_input import ROOT, TOY, TOYS

CLOSED = "python -m visctrl run toy.yaml --out o"


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    (tmp_path / "toy.yaml").write_text(TOY)
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (ROOT, TOYS)))}


@pytest.mark.parametrize(
    ("redirection", "code"),
    [
        (">&-", 0),
        (">&- 2>&-", 0),
        ("<&- >&- 2>&-", 0),
        ("> /dev/full", 3),
        ("> /dev/full 2>&1", 3),
        ("--json > /dev/full", 3),
        ("2>&1 | true", 0),
        ("| true", 0),
    ],
)
def test_streams(environment: dict[str, str], tmp_path: Path, redirection: str, code: int) -> None:
    command = f"{sys.executable} -m visctrl run toy.yaml --out o {redirection}"
    if "|" in redirection:
        command = f"set -o pipefail; {command}"
    done = subprocess.run(
        ["bash", "-c", command], cwd=tmp_path, env=environment, capture_output=True, text=True,
        timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    assert json.loads((tmp_path / "o" / "summary.json").read_text())["status"] == "reached"
    assert (tmp_path / "o" / "report.html").exists()


def test_a_terminal_that_knows_only_ascii(environment: dict[str, str], tmp_path: Path) -> None:
    plain = {**environment, "PYTHONIOENCODING": "ascii", "LC_ALL": "C", "PYTHONUTF8": "0"}
    done = subprocess.run(
        [sys.executable, "-m", "visctrl", "run", "toy.yaml", "--out", "öü"],
        cwd=tmp_path, env=plain, capture_output=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.isascii()


def test_a_current_directory_that_is_gone(environment: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "gone").mkdir()
    program = f"{sys.executable} -m visctrl"
    script = (
        f"cd gone; rmdir ../gone; {program} run mock -q; {program} run mock -q --out {tmp_path}/o"
    )
    done = subprocess.run(
        ["bash", "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True,
        timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith("visctrl: runs/")
    assert "the current directory is gone" in done.stderr
    assert done.stderr.count("\n") == 1


INTERRUPTED = """
import os, runpy, signal, sys
class Hook:
    def find_spec(self, name, *others):
        if name == os.environ.get("INTERRUPTED_AT"):
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Hook())
runpy.run_module("visctrl", run_name="__main__")
"""


@pytest.mark.parametrize(
    "module",
    [
        *("typer", "visctrl.cli.main", "rich.console", "yaml", "numpy", "numpy.linalg"),
        *("visctrl.runtime.session", "visctrl.hal.mock.backend", "toy_plugins"),
    ],
)
def test_ctrl_c_while_the_program_is_still_being_imported(
    environment: dict[str, str], tmp_path: Path, module: str
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, "run", "toy.yaml", "-q", "--out", "o"],
        cwd=tmp_path, env={**environment, "INTERRUPTED_AT": module}, capture_output=True,
        text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 130, done.stderr
    assert done.stderr == "visctrl: stopped by Ctrl-C\n"


@pytest.mark.parametrize(
    ("arguments", "code", "stream", "word"),
    [
        (["doctor"], 3, "stdout", "failure"),
        (["run", "default", "--backend", "sim"], 2, "stderr", "pybullet"),
    ],
)
def test_a_machine_without_pybullet(
    tmp_path: Path, arguments: list[str], code: int, stream: str, word: str
) -> None:
    program = (
        "import sys\n"
        "sys.modules['pybullet'] = None\n"
        f"sys.argv = ['visctrl', *{arguments!r}]\n"
        "from visctrl.cli.main import main\n"
        "main()\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env=environment,
    )
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    assert word in getattr(done, stream)
