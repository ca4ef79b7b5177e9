"""`visctrl run --backend pioneer` and `visctrl teach`, against the emulator on simulated time."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from virtual_robot import Site, renamed_robot

from visctrl.cli.main import main
from visctrl.hal.cameras.models.unified import UnifiedCamera
from visctrl.hal.emulator.emulator import Emulator
from visctrl.hal.emulator.firmware import STEP_S
from visctrl.hal.emulator.firmware_profile import SIMULATOR, Personality
from visctrl.hal.emulator.world import Room
from visctrl.hal.pioneer.commands import Command, Id, decode_command
from visctrl.hal.types import STANDSTILL
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.target_view import TargetView, load_target

ROOT = Path(__file__).parents[2]
MODEL = UnifiedCamera(
    name="small", width=160, height=120, xi=0.0, fx=100.0, fy=100.0, cx=79.5, cy=59.5
)
SCENARIO = """
backend: pioneer
camera: {name: small.yaml}
perception: {name: blind}
estimator: {name: toy}
controller: {name: toy, v: 0.4, omega: 0.3, drive_s: 20}
approach: {enabled: false}
safety: {acceleration_m_s2: 1.0}
target: {file: target.npz}
"""
SPEED = 0.4
CAMERA = "http://camera/stream.mjpg"
Run = Callable[..., tuple[int, dict[str, object], str]]
#: Limits to standstill (s): where the driver can act, and where only the robot's watchdog can.
DRIVER_S, WATCHDOG_S = 0.6, 2.1


@pytest.fixture
def robot(site: Site) -> Emulator:
    return site.robot()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the program runs, with a scenario of plugins that do little."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "toy.yaml").write_text(SCENARIO)
    (tmp_path / "small.yaml").write_text(MODEL.model_dump_json())
    TargetView(np.zeros((1, 120, 160), np.uint8), MODEL).save(tmp_path / "target.npz")
    for room in ("runtime", "cli"):
        monkeypatch.syspath_prepend(ROOT / "tests" / room)
    monkeypatch.setitem(REGISTRIES.perception.builtin, "blind", "blind_plugins:Blind")
    monkeypatch.setitem(REGISTRIES.estimators.builtin, "toy", "toy_plugins:ToyEstimator")
    monkeypatch.setitem(REGISTRIES.estimators.builtin, "reckoning", "blind_plugins:Reckoning")
    monkeypatch.setitem(REGISTRIES.controllers.builtin, "toy", "toy_plugins:ToyController")
    return tmp_path


@pytest.fixture
def visctrl(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Return a function that runs the program; it gives exit code, output and messages."""

    def call(*arguments: str) -> tuple[int, str, str]:
        capfd.readouterr()
        monkeypatch.setattr(sys, "argv", ["visctrl", *arguments])
        with pytest.raises(SystemExit) as caught:
            main()
        out, err = capfd.readouterr()
        assert "Traceback" not in err
        return int(caught.value.code or 0), out, err

    return call


@pytest.fixture
def run(visctrl: Callable[..., tuple[int, str, str]], robot: Emulator) -> Run:
    """Return a function that runs the scenario; it gives exit code, summary and messages."""

    def call(*arguments: str) -> tuple[int, dict[str, object], str]:
        command = ["run", "toy.yaml", "--json", "--quiet", "--out", "o", "--overwrite"]
        devices = ["--port", robot.url, "--camera-url", CAMERA]
        code, out, err = visctrl(*command, *devices, *arguments)
        return code, json.loads(out) if out else {}, err

    return call


def everything_is_released(site: Site) -> bool:
    lines = site.ports.lines.values()
    return not any(line.open for line in lines) and site.film.opened == site.film.released


@pytest.mark.parametrize(
    ("url", "personality"), [("/dev/robot", None), ("socket://robot:8101", SIMULATOR)]
)
def test_a_run_over_the_whole_real_path(
    site: Site, run: Run, url: str, personality: Personality | None
) -> None:
    robot = site.robot(url) if personality is None else site.robot(url, personality=personality)
    code, summary, messages = run("--port", url, "--set", "controller.drive_s=1.5")
    # Black pictures decide nothing; the controller finished all the same.
    assert (code, summary["status"]) == (1, "doubtful"), messages
    assert "the controller finished, but the picture cannot tell" in str(summary["reason"])
    assert summary["truth"] is None
    assert summary["missed_ticks"] == 0
    assert robot.pose.y > 0.3
    assert robot.velocity == STANDSTILL
    assert not robot.motors
    assert robot.traffic.violations() == []
    assert everything_is_released(site)


@dataclass(frozen=True)
class Case:
    """A fault of robot, line or camera, how soon the robot must stand, and what is said."""

    kind: str
    value: float | None
    limit: float
    says: str


CASES = (
    Case("lost", 1.0, WATCHDOG_S, "not reported for"),
    Case("corrupt", 1.0, WATCHDOG_S, "not reported for"),
    Case("delay", 5.0, WATCHDOG_S, "not reported for"),
    Case("deaf", None, WATCHDOG_S, "does not hear"),
    Case("silent", None, DRIVER_S, "not reported for"),
    Case("rubbish", None, DRIVER_S, "not reported for"),
    Case("reset", 255, DRIVER_S, "controller has restarted"),
    Case("reset", 254, DRIVER_S, "controller has restarted"),
    Case("stall", None, DRIVER_S, "the left wheel is stalled"),
    Case("bumper", None, DRIVER_S, "a front bumper is pressed"),
    Case("estop", None, DRIVER_S, "the emergency stop is pressed"),
    Case("charging", None, DRIVER_S, "take it off the charger"),
    Case("low-battery", 10.5, DRIVER_S, "the battery is low: 10.5 V"),
    Case("camera-frozen", None, DRIVER_S, "the camera has frozen"),
    Case("camera-dropped", None, DRIVER_S, "the stream has dropped"),
)


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.kind}-{case.value}")
def test_fault_at_full_speed(site: Site, robot: Emulator, run: Run, case: Case) -> None:
    """Standstill in time, a message, exit code 3, everything released; the next run works."""
    began = 0.0

    def happen() -> None:
        nonlocal began
        site.wait_until(lambda: robot.velocity.v > SPEED - 1e-6)
        site.world.sleep(0.06)  # between two reports, pictures and commands
        began = robot.now()
        switch(site, robot, case, on=True)

    site.meanwhile(happen)
    code, summary, messages = run()
    assert (code, summary["status"]) == (3, "fault")
    assert case.says in messages
    assert everything_is_released(site)
    site.wait_until(lambda: robot.standing_since is not None, WATCHDOG_S)
    assert -STEP_S < (robot.standing_since or 0.0) - began <= case.limit
    switch(site, robot, case, on=False)
    if case.kind == "delay":  # the line first delivers what it held back
        site.world.sleep(5.0)
    code, _, messages = run("--set", "controller.drive_s=0.5")
    assert code == 1, messages
    assert "the controller finished" in messages
    if case.kind not in ("lost", "corrupt"):  # those have spoilt what was sent
        assert robot.traffic.violations() == []


def switch(site: Site, robot: Emulator, case: Case, *, on: bool) -> None:
    """Let a fault begin or end."""
    match case.kind:
        case "camera-frozen":
            site.film.frozen = on
        case "camera-dropped":
            site.film.dropped = on
        case _ if on:
            robot.faults.switch_on(case.kind, case.value)
        case _:
            robot.faults.switch_off(case.kind)


def test_hung_plugin(site: Site, robot: Emulator, run: Run, monkeypatch: Any) -> None:
    """The robot is stopped while a plugin does not return, and the run goes on afterwards."""
    monkeypatch.setattr("toy_plugins.ToyController.sleep", site.world.sleep)
    stall = ("controller.at_s=2.0", "controller.trouble=stall", "controller.stall_s=1.5")
    stood = []
    site.meanwhile(lambda: stood.append(stops_while_hung(site, robot)))
    code, _, messages = run(*sets("controller.drive_s=3.0", *stall))
    assert code == 1, messages
    assert "the controller finished" in messages
    assert stood[0] < 0.6
    assert "by cause: control" in messages
    assert robot.traffic.violations() == []


def stops_while_hung(site: Site, robot: Emulator) -> float:
    """Return how long after its last command the robot stands."""
    site.wait_until(lambda: robot.velocity.v > SPEED - 1e-6)
    site.wait_until(lambda: robot.velocity == STANDSTILL)
    commands = [entry for entry in robot.traffic.entries if decode_command(entry.packet).id == 11]
    moving = [entry for entry in commands if decode_command(entry.packet).argument]
    return robot.now() - moving[-1].latest


def sets(*settings: str) -> list[str]:
    return [word for setting in settings for word in ("--set", setting)]


@pytest.mark.parametrize(
    ("trouble", "code", "says"),
    [
        ("sigterm", 143, "stopped by SIGTERM"),
        ("sigint", 130, "stopped by Ctrl-C"),
        ("raise", 3, "toy trouble"),
        ("nan", 3, "not finite"),
    ],
)
def test_whatever_ends_a_run_the_robot_is_left_in_order(
    site: Site, robot: Emulator, run: Run, trouble: str, code: int, says: str
) -> None:
    done, _, messages = run(*sets("controller.at_s=0.8", f"controller.trouble={trouble}"))
    assert done == code
    assert says in messages
    assert robot.velocity == STANDSTILL
    assert not robot.motors
    commands = [str(command) for command in robot.traffic.commands()]
    assert commands[-5:] == ["E_STOP", "VEL 0", "RVEL 0", "ENABLE 0", "CLOSE"]
    assert robot.traffic.violations() == []
    assert everything_is_released(site)


# --- what cannot be used ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["--port", "/dev/does-not-exist"], 3, "there is no such port"),
        (["--camera-url", "http://127.0.0.1:9/x.mjpg"], 3, "cannot be opened"),
        (["--target", "nothing.npz"], 2, "visctrl teach"),
        (["--target", "toy.yaml"], 2, "not a target view"),
        (["--set", "camera.width=320"], 2, "taken by camera 'small'"),
        (["--robot", "p3at"], 2, "--robot p3dx"),
        (["--set", "target.file=null"], 2, "visctrl teach"),
        (["--backend", "mock"], 2, "not an option of backend 'mock', but of: pioneer"),
    ],
)
def test_what_cannot_be_used(
    site: Site, robot: Emulator, run: Run, arguments: list[str], code: int, says: str
) -> None:
    done, _, messages = run(*arguments)
    assert done == code
    assert says in messages
    assert robot.pose == (0.0, 0.0, 0.0)
    assert not robot.motors
    assert everything_is_released(site)


def test_busy_port(site: Site, robot: Emulator, run: Run) -> None:
    site.line(robot).open = True
    code, _, messages = run()
    assert code == 3
    assert "in use by another process" in messages
    assert robot.traffic.commands() == []


def test_port_that_answers_rubbish(robot: Emulator, run: Run) -> None:
    robot.faults.switch_on("rubbish")
    code, _, messages = run()
    assert code == 3
    assert "only noise arrives" in messages
    assert not robot.motors


def test_unknown_subclass(run: Run, site: Site, tmp_path: Path) -> None:
    robot = site.robot("/dev/other", str(renamed_robot(tmp_path, "seekur")))
    code, _, messages = run("--port", robot.url)
    assert code == 3
    assert "calls itself 'seekur', which is not known here" in messages
    assert not robot.motors
    assert robot.traffic.commands()[-1] == Command(Id.CLOSE)


def test_camera_of_another_size_than_its_calibration(site: Site, robot: Emulator, run: Run) -> None:
    site.film.size = (320, 240)
    code, _, messages = run()
    assert code == 3
    assert "it delivers 320x240" in messages
    assert robot.traffic.commands() == []


# --- sonar -----------------------------------------------------------------------------------


def test_the_sonar_of_the_robot_keeps_it_from_a_wall(site: Site, run: Run) -> None:
    """The echoes of SIP packets reach the obstacle provider: the target lies behind a wall."""
    room = Room(-2.5, 2.5, -2.0, 1.8)
    robot = site.robot("/dev/robot", surroundings=room)
    chosen = (
        *("scheme=pose", "estimator={name: reckoning}", "duration_s=25"),
        *("controller={name: pose-tracking, tau_s: 15}", "obstacles=[{name: sonar}]"),
    )
    code, summary, messages = run(*(part for text in chosen for part in ("--set", text)))
    assert code == 1, messages
    assert "had not finished" in str(summary["reason"])
    assert -0.5 < robot.pose.y < room.y_max - 0.4
    assert robot.velocity == STANDSTILL
    with open("o/ticks.csv", encoding="utf-8") as file:
        ticks = list(csv.DictReader(file))
    phases = dict.fromkeys(tick["phase"] for tick in ticks)
    assert list(phases)[:4] == ["path", "stop", "look", "back"]
    assert float(ticks[-1]["sonar.cells [1]"]) > 10


def test_sonar_that_is_switched_off_is_not_relied_on(run: Run) -> None:
    chosen = ("scheme=pose", "controller={name: pose-tracking}", "pioneer.sonar=false")
    code, _, messages = run(
        *(part for text in chosen for part in ("--set", text)),
        *("--set", "estimator={name: reckoning}", "--set", "obstacles=[{name: sonar}]"),
    )
    assert code == 2
    assert "needs range sensors" in messages
    assert "switched off" in messages


# --- teaching --------------------------------------------------------------------------------


def test_teaching_while_something_moves(
    robot: Emulator, folder: Path, visctrl: Callable[..., tuple[int, str, str]]
) -> None:
    (folder / "target.npz").unlink()  # what a scenario names before it has been taught
    devices = ["--port", robot.url, "--camera-url", CAMERA]
    code, _, messages = visctrl("teach", "toy.yaml", "-o", "new.npz", "--frames", "3", *devices)
    assert code == 2
    assert "differs from the first" in messages
    assert not (folder / "new.npz").exists()
    assert robot.traffic.violations() == []


def test_target_view_survives_its_file(tmp_path: Path) -> None:
    images = np.random.default_rng(0).integers(0, 255, (2, 120, 160), dtype=np.uint8)
    view = TargetView(images, MODEL, backend="pioneer", robot="p3dx", taken="2026-01-01")
    view.save(tmp_path / "a.npz")
    again = load_target(tmp_path / "a.npz")
    assert np.array_equal(again.images, images)
    assert (again.camera, again.taken, again.odometry) == (MODEL, "2026-01-01", None)
    assert [frame.sequence for frame in again.frames()] == [0, 1]
