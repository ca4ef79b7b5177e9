"""The program as its user meets it: options, output, exit codes, signals."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import pytest
import yaml

from visctrl.cli.main import main
from visctrl.runtime.registry import REGISTRIES

ROOT = Path(__file__).parents[2]
TOYS = ROOT / "tests" / "runtime"

ENTRY_POINTS = """
[visctrl.estimators]
toy = toy_plugins:ToyEstimator
[visctrl.controllers]
toy = toy_plugins:ToyController
"""
SCENARIO = """
backend: mock
estimator: {name: toy}
controller: {name: toy}
approach: {enabled: false}
start: {x_m: 0, y_m: -1, phi_deg: 0}
"""


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Variables under which the toy plugins are an installed package."""
    info = tmp_path / "site" / "toys-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toys\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    (tmp_path / "toy.yaml").write_text(SCENARIO)
    paths = os.pathsep.join(map(str, (tmp_path / "site", TOYS, ROOT)))
    return {**os.environ, "PYTHONPATH": paths, "COLUMNS": "200"}


@dataclass
class Done:
    """What a call of the program came to."""

    returncode: int
    stdout: str
    stderr: str


Call = Callable[..., Done]


@pytest.fixture
def visctrl(
    tmp_path: Path,
    environment: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> Call:
    """Return a function that runs the program in this process, in an empty directory.

    The toy plugins are installed.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(TOYS)
    monkeypatch.setitem(REGISTRIES.estimators.builtin, "toy", "toy_plugins:ToyEstimator")
    monkeypatch.setitem(REGISTRIES.controllers.builtin, "toy", "toy_plugins:ToyController")

    def call(*arguments: str) -> Done:
        capfd.readouterr()
        monkeypatch.setattr(sys, "argv", ["visctrl", *arguments])
        with pytest.raises(SystemExit) as caught:
            main()
        out, err = capfd.readouterr()
        return Done(int(caught.value.code or 0), out, err)

    return call


def test_json_is_the_summary_and_nothing_else(visctrl: Call, tmp_path: Path) -> None:
    done = visctrl("run", "toy.yaml", "--json", "--out", "here")
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["status"] == "reached"
    assert summary == json.loads((tmp_path / "here" / "summary.json").read_text())
    assert "main stage" in done.stderr, "progress goes to stderr"


def test_a_table_without_json_and_a_directory_of_its_own(visctrl: Call, tmp_path: Path) -> None:
    done = visctrl("run", "toy.yaml")
    assert done.returncode == 0, done.stderr
    assert "reached" in done.stdout
    assert "final error" in done.stdout
    (directory,) = (tmp_path / "runs").iterdir()
    assert str(directory.relative_to(tmp_path)) in done.stdout


def test_options_override_the_scenario_and_start_takes_negative_numbers(
    visctrl: Call, tmp_path: Path
) -> None:
    done = visctrl(
        *("run", "toy.yaml", "--start", "-0.1", "-1.5", "-10", "--robot", "p3at", "--seed", "5"),
        *("--camera", "fisheye", "--noise-px", "0.5", "--duration", "1", "--quiet"),
        *("--tolerance", "0.5", "9", "--set", "mock.features=33", "--set", "seed=4", "--out", "o"),
    )
    assert done.returncode == 1, done.stderr
    assert done.stdout == ""
    assert "the controller had not finished after 1" in done.stderr
    effective = yaml.safe_load((tmp_path / "o" / "config.yaml").read_text())
    assert effective["start"] == {"x_m": -0.1, "y_m": -1.5, "phi_deg": -10.0}
    assert (effective["robot"], effective["seed"], effective["duration_s"]) == ("p3at", 5, 1.0)
    assert effective["camera"]["name"] == "fisheye"
    assert effective["mock"]["noise_px"] == 0.5
    assert effective["mock"]["features"] == 33
    assert effective["tolerance"] == {"position_m": 0.5, "heading_deg": 9.0}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--robot", "p3dy"], ["--robot p3dy", "unknown robot", "did you mean 'p3dx'"]),
        (["--backend", "simulator"], ["--backend simulator", "known: mock"]),
        (["--scheme", "trifocale"], ["did you mean 'trifocal'"]),
        (["--set", "controler.v=1"], ["unknown key 'controler'", "did you mean 'controller'"]),
        (["--set", "controller.v=x"], ["--set controller.v=x", "number"]),
        (["--seed", "-3"], ["--seed -3", "greater than or equal to 0"]),
        (["--gui"], ["--gui", "not an option of backend 'mock', but of: sim"]),
        (["--backend", "sim", "--noise-px", "1"], ["--noise-px", "backend 'sim'", "of: mock"]),
        (["--start", "500", "0", "0"], ["--start", "start.x_m", "100"]),
        (["--start", "a", "b", "c"], ["--start"]),
        (["--tolerance", "-1", "1"], ["--tolerance", "greater than 0"]),
        (["--out", "toy.yaml"], ["--out toy.yaml", "cannot be written"]),
    ],
)
def test_bad_input_is_one_message_and_exit_code_2(
    visctrl: Call, tmp_path: Path, arguments: list[str], words: list[str]
) -> None:
    done = visctrl("run", "toy.yaml", *arguments)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in done.stderr
    assert done.stdout == ""
    assert not (tmp_path / "runs").exists(), "nothing was started"


def test_plugin_faults_are_told_without_a_traceback(visctrl: Call, tmp_path: Path) -> None:
    done = visctrl("run", "toy.yaml", "--set", "controller.at_s=1", "--json", "--out", "o")
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    assert json.loads(done.stdout)["status"] == "fault"
    assert "toy trouble" in done.stderr
    assert "toy_plugins.py" in (tmp_path / "o" / "fault.txt").read_text()


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (signal.SIGINT, 130),
        (signal.SIGTERM, 143),
        (signal.SIGHUP, 129),
        (signal.SIGQUIT, 131),
        (signal.SIGTSTP, 148),
    ],
)
def test_signals_end_a_run_in_good_order(
    environment: dict[str, str], tmp_path: Path, number: signal.Signals, code: int
) -> None:
    """From outside, as a terminal or a supervisor sends them, on the wall clock."""
    command = ("run", "toy.yaml", "--realtime", "--set", "controller.drive_s=60", "--out", "o")
    process = subprocess.Popen(
        [sys.executable, "-m", "visctrl", *command, "--json"],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    log = tmp_path / "o" / "ticks.csv"
    wait_for(lambda: log.exists() and len(log.read_text().splitlines()) > 5, process)
    process.send_signal(number)
    out, err = process.communicate(timeout=30)
    assert process.returncode == code, err
    summary = json.loads(out)
    assert summary["status"] == "stopped"
    assert "Traceback" not in err
    files = {path.name for path in (tmp_path / "o").iterdir()}
    assert {"ticks.csv", "summary.json", "final.png", "report.html"} <= files


def test_the_module_is_the_program(environment: dict[str, str], tmp_path: Path) -> None:
    """As a whole process, with plugins found through their entry points."""
    done = subprocess.run(
        [sys.executable, "-m", "visctrl", "run", "toy.yaml", "--json", "--out", "o", "--video"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["status"] == "reached"
    assert (tmp_path / "o" / "report.html").stat().st_size > 10_000
    video = cv2.VideoCapture(str(tmp_path / "o" / "video.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 51
    ok, picture = video.read()
    assert ok
    assert picture.shape == (600, 1400, 3), "the robot from above beside the image"


def test_a_killed_run_leaves_a_readable_log(environment: dict[str, str], tmp_path: Path) -> None:
    command = ("run", "toy.yaml", "--realtime", "--set", "controller.drive_s=60", "--out", "o")
    process = subprocess.Popen(
        [sys.executable, "-m", "visctrl", *command],
        cwd=tmp_path,
        env=environment,
        stderr=subprocess.DEVNULL,
    )
    log = tmp_path / "o" / "ticks.csv"
    wait_for(lambda: log.exists() and len(log.read_text().splitlines()) > 5, process)
    process.kill()
    process.wait(timeout=30)
    header, *lines = log.read_text().splitlines()
    assert all(line.count(",") == header.count(",") for line in lines)
    assert (tmp_path / "o" / "config.yaml").stat().st_size > 0


def test_resolve_prints_what_can_be_run_again(visctrl: Call, tmp_path: Path) -> None:
    done = visctrl("config", "--resolve", "toy.yaml", "--set", "seed=9")
    assert done.returncode == 0, done.stderr
    effective = yaml.safe_load(done.stdout)
    assert effective["seed"] == 9
    assert effective["controller"]["drive_s"] == 5.0
    (tmp_path / "resolved.yaml").write_text(done.stdout)
    again = visctrl("config", "resolved.yaml", "--resolve")
    assert yaml.safe_load(again.stdout) == effective


def test_list_names_everything(visctrl: Call) -> None:
    done = visctrl("list")
    assert done.returncode == 0, done.stderr
    for word in ("p3dx", "p3at", "hypercatadioptric", "fisheye", "mock", "toy", "default", "klt"):
        assert word in done.stdout


def test_version_and_help(visctrl: Call) -> None:
    from visctrl import __version__

    assert visctrl("--version").stdout == f"visctrl {__version__}\n"
    shown = visctrl("run", "--help")
    assert shown.returncode == 0
    for option in (
        "--backend",
        "--start",
        "--noise-px",
        "--realtime",
        "--json",
        "--video",
        "--gui",
    ):
        assert option in shown.stdout


def wait_for(condition: Callable[[], bool], process: subprocess.Popen[Any]) -> None:
    deadline = time.monotonic() + 40
    while not condition():
        assert process.poll() is None, "the process ended"
        assert time.monotonic() < deadline, "it took too long"
        time.sleep(0.05)
