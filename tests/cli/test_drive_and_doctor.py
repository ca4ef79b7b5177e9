"""Driving by hand, and the doctor's findings, against the emulator."""

from __future__ import annotations

import fcntl
import os
import re
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import yaml
from virtual_robot import Site

from visctrl.cli.drive import Hand, split_keys
from visctrl.cli.main import main
from visctrl.hal.cameras.models.unified import UnifiedCamera
from visctrl.hal.clock import WallClock
from visctrl.hal.emulator.emulator import Emulator
from visctrl.hal.emulator.firmware import Firmware
from visctrl.hal.emulator.firmware_profile import emulated, profile
from visctrl.hal.emulator.ports import PtyPort
from visctrl.hal.errors import LinkError
from visctrl.hal.pioneer.base import PioneerBase
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.robots import load_robot

ROOT = Path(__file__).parents[2]
CAMERA = "http://camera/stream.mjpg"

# --- keys on simulated time ------------------------------------------------------------------


@dataclass
class Fingers:
    """Keys that are held, and repeat as a keyboard lets them."""

    site: Site
    held: list[tuple[float, float, str]] = field(default_factory=list)
    _looked: float = 0.0

    def pressed(self) -> list[str]:
        before, self._looked = self._looked, self.site.world.now
        repeats = [
            (begin + k * 0.04, key)
            for begin, end, key in self.held
            for k in range(round((end - begin) / 0.04) + 1)
        ]
        return [key for t, key in sorted(repeats) if before < t <= self._looked]


@dataclass
class Driven:
    """A robot that was driven by hand: (time, velocity) every 10 ms, and what came of it."""

    robot: Emulator
    trace: list[tuple[float, Velocity]] = field(default_factory=list)
    error: Exception | None = None

    def at(self, t: float) -> Velocity:
        return min(self.trace, key=lambda row: abs(row[0] - t))[1]


def driven(site: Site, *held: tuple[float, float, str], fault: str = "") -> Driven:
    """Let a hand drive for 8 s with keys held from then to then (s); then quit."""
    it = Driven(site.robot())
    base = PioneerBase(it.robot.url, load_robot("p3dx"), load_robot("p3dx").operating, WallClock())
    base.open()
    begun = site.world.now
    keys = [(begun + a, begun + b, key) for a, b, key in (*held, (8.0, 8.0, "q"))]

    def watch() -> None:
        while True:
            t = site.world.now - begun
            it.trace.append((t, it.robot.velocity))
            if fault and t >= 1.0:
                it.robot.faults.switch_on(fault)
            site.world.sleep(0.01)

    site.meanwhile(watch)
    try:
        Hand(base, Fingers(site, keys), WallClock(), Velocity(0.3, 0.35)).run()
    except LinkError as error:
        it.error = error
    finally:
        base.close()
    assert it.robot.velocity == STANDSTILL
    assert not it.robot.motors
    assert it.robot.traffic.violations() == []
    return it


def test_it_moves_while_a_key_is_held_and_stops_when_not(site: Site) -> None:
    it = driven(site, (0.5, 2.0, "w"), (4.0, 5.0, "\x1b[D"))
    assert it.at(0.45) == STANDSTILL
    assert it.at(2.0) == (pytest.approx(0.3), 0.0)
    # The key's hold, the command's period, and the ramp from 0.3 m/s at 0.3 m/s2.
    assert it.at(2.0 + 0.35 + 0.1 + 1.0 + 0.1) == STANDSTILL
    assert it.at(5.0).omega > 0.3
    assert it.at(5.0).v == 0.0
    assert it.at(6.5) == STANDSTILL


@pytest.mark.parametrize(
    ("key", "sign"), [("w", (1, 0)), ("s", (-1, 0)), ("a", (0, 1)), ("d", (0, -1))]
)
def test_directions(site: Site, key: str, sign: tuple[int, int]) -> None:
    v, omega = driven(site, (0.5, 1.5, key)).at(1.5)
    assert ((v > 0) - (v < 0), (omega > 0) - (omega < 0)) == sign


def test_space_brakes_hard(site: Site) -> None:
    it = driven(site, (0.5, 2.0, "w"), (2.05, 2.05, " "))
    assert it.at(2.2) == STANDSTILL


def test_slower(site: Site) -> None:
    it = driven(site, (0.2, 0.2, "-"), (0.3, 0.3, "-"), (0.5, 2.5, "w"))
    assert it.at(2.5).v == pytest.approx(0.3 / 1.25**2, abs=0.001)


def test_bumper_holds_the_robot_however_long_a_key_is_held(site: Site) -> None:
    it = driven(site, (0.2, 4.0, "w"), fault="bumper")
    assert it.at(0.99).v > 0.1
    assert it.at(1.6) == it.at(3.9) == STANDSTILL


def test_lost_robot_ends_the_drive(site: Site) -> None:
    it = driven(site, (0.2, 4.0, "w"), fault="silent")
    assert "not reported" in str(it.error)


def test_keys() -> None:
    assert split_keys("w\x1b[A\x1b[Dq \x1b") == ["w", "\x1b[A", "\x1b[D", "q", " ", "\x1b"]


# --- the program on a terminal ---------------------------------------------------------------


@pytest.fixture
def emulator() -> Iterator[Emulator]:
    with Emulator(Firmware(profile(emulated("p3dx-sh"))), PtyPort()) as emulator:
        yield emulator


def wait_until(done: Callable[[], bool], limit: float = 60.0) -> None:
    start = time.monotonic()
    while not done():
        assert time.monotonic() - start < limit, "it never happened"
        time.sleep(0.01)


@contextmanager
def driving(emulator: Emulator, *options: str) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """The program on a terminal of its own: the process, and the keyboard's end."""
    keyboard, terminal = os.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "visctrl", "drive", "--port", emulator.url, *options],
        stdin=terminal, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    try:
        wait_until(lambda: emulator.motors)
        yield process, keyboard
    finally:
        process.kill()
        process.wait()
        os.close(keyboard)
        os.close(terminal)


def test_terminal_that_is_closed(emulator: Emulator) -> None:
    """Its own end is gone, and so is the keyboard's: the robot stands, the drive is over."""
    keyboard, terminal = os.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "visctrl", "drive", "--port", emulator.url],
        stdin=terminal, stdout=terminal, stderr=terminal, start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )  # fmt: skip
    os.close(terminal)
    try:
        wait_until(lambda: emulator.motors)

        def moving() -> bool:
            os.write(keyboard, b"w")
            return emulator.velocity.v > 0.05

        wait_until(moving)
        os.close(keyboard)
        assert process.wait(30.0) in (0, 128 + signal.SIGHUP)
        assert emulator.velocity == STANDSTILL
        assert not emulator.motors
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize(("how", "code"), [("quit", 0), ("terminate", 143)])
def test_program_on_a_terminal(emulator: Emulator, how: str, code: int) -> None:
    with driving(emulator) as (process, keyboard):

        def moving() -> bool:
            os.write(keyboard, b"w")
            return emulator.velocity.v > 0.05

        wait_until(moving)
        if how == "quit":
            os.write(keyboard, b"q")
        else:
            process.send_signal(signal.SIGTERM)
        assert process.wait(30.0) == code
        assert emulator.velocity == STANDSTILL
        assert not emulator.motors


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["visctrl", *arguments])
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as caught:
        main()
    return int(caught.value.code or 0)


@pytest.mark.parametrize(
    ("options", "says"),
    [([], "needs a terminal"), (["--speed", "3"], "at most 0.4"), (["--robot", "x"], "p3dx")],
)
def test_driving_that_cannot_begin(
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    options: list[str],
    says: str,
) -> None:
    assert call(monkeypatch, "drive", "--port", "/dev/null", *options) == 2
    assert says in capfd.readouterr().err


# --- the doctor ------------------------------------------------------------------------------


def test_doctor_examines_robot_and_camera(
    site: Site,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    model = UnifiedCamera(
        name="small", width=160, height=120, xi=0.0, fx=100.0, fy=100.0, cx=79.5, cy=59.5
    )
    calibration = tmp_path / "small.yaml"
    calibration.write_text(yaml.safe_dump(model.model_dump()))
    robot = site.robot()
    code = call(
        monkeypatch,
        *("doctor", "--quick", "--port", robot.url),
        *("--camera-url", CAMERA, "--camera", str(calibration)),
    )
    text = capfd.readouterr().out
    assert code == 0, text
    for word in ("python", "pybullet", "p3dx-sh", "watchdog 2000 ms", "12.8 V", "160x120",
                 "10.0 pictures/s"):  # fmt: skip
        assert word in text
    assert re.search(r"the newest at most 0\.(09|10) s old", text)
    assert "failure" not in text
    assert robot.pose == (0.0, 0.0, 0.0)
    assert "ENABLE 1" not in {str(command) for command in robot.traffic.commands()}


def test_doctor_names_the_remedy(
    site: Site, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    robot = site.robot(subclass="p3at-sh")
    robot.faults.switch_on("low-battery", 10.2)
    robot.faults.switch_on("estop")
    assert call(monkeypatch, "doctor", "--quick", "--port", robot.url) == 3
    out = capfd.readouterr().out
    assert "10.2 V -> charge it" in out
    assert "the emergency stop is pressed -> release it" in out
    assert call(monkeypatch, "doctor", "--quick", "--camera-url", "97") == 3
    assert "video devices here" in capfd.readouterr().out


def test_doctor_wants_a_faster_camera(
    site: Site, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    site.film.rate, site.film.size = 6.0, (800, 600)
    assert call(monkeypatch, "doctor", "--quick", "--camera-url", CAMERA) == 0
    out = capfd.readouterr().out
    assert "6.0 pictures/s" in out
    assert "more light" in out
