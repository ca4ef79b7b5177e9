"""Driving by hand, and the doctor's findings, against the emulator."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from hal.central_camera import CentralCamera
from hal.pioneer.emulator.character import character
from hal.pioneer.emulator.emulator import Emulator
from hal.pioneer.emulator.faults import Fault, FaultSchedule
from hal.pioneer.emulator.firmware import Firmware
from hal.pioneer.emulator.ports import PtyPort
from hal.pioneer.emulator.stream import MjpegServer
from visctrl.cli.drive import split_keys
from visctrl.cli.main import main

pytestmark = pytest.mark.realtime
ROOT = Path(__file__).parents[2]


@pytest.fixture
def emulator() -> Iterator[Emulator]:
    with Emulator(Firmware(character("p3dx-sh")), PtyPort()) as emulator:
        yield emulator


def wait_until(done: Callable[[], bool], limit: float = 10.0) -> None:
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
        wait_until(lambda: emulator.motors, 60.0)
        yield process, keyboard
    finally:
        process.kill()
        process.wait()
        os.close(keyboard)
        os.close(terminal)


def hold(keyboard: int, key: str, seconds: float) -> None:
    """Press a key and keep it, as a keyboard repeats it."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        os.write(keyboard, key.encode())
        time.sleep(0.04)


def test_it_moves_while_a_key_is_held_and_stops_when_not(emulator: Emulator) -> None:
    with driving(emulator, "--speed", "0.3") as (process, keyboard):
        hold(keyboard, "w", 1.5)
        assert emulator.velocity.v == pytest.approx(0.3)
        released = emulator.now()
        wait_until(lambda: emulator.velocity == (0.0, 0.0), 2.0)
        # The key's hold, the command's period, and the ramp from 0.3 m/s at 0.3 m/s2.
        assert emulator.now() - released < 0.35 + 0.1 + 1.0 + 0.2
        hold(keyboard, "\x1b[D", 0.5)
        assert emulator.velocity.omega > 0.1
        os.write(keyboard, b" ")
        wait_until(lambda: emulator.velocity == (0.0, 0.0), 0.4)
        os.write(keyboard, b"q")
        assert process.wait(10.0) == 0
    assert not emulator.motors
    assert emulator.traffic.violations() == []


def test_terminating_the_program_stops_the_robot(emulator: Emulator) -> None:
    with driving(emulator) as (process, keyboard):
        hold(keyboard, "w", 0.8)
        process.send_signal(signal.SIGTERM)
        assert process.wait(10.0) == 143
        assert emulator.velocity == (0.0, 0.0)
        assert not emulator.motors


def test_keys() -> None:
    assert split_keys("w\x1b[A\x1b[Dq \x1b") == ["w", "\x1b[A", "\x1b[D", "q", " ", "\x1b"]


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


def test_doctor_examines_robot_and_camera(
    emulator: Emulator,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    model = CentralCamera(
        name="small", width=160, height=120, xi=0.0, fx=100.0, fy=100.0, cx=79.5, cy=59.5
    )
    calibration = tmp_path / "small.yaml"
    calibration.write_text(yaml.safe_dump(model.model_dump()))
    stop = threading.Event()
    with MjpegServer() as server:

        def film() -> None:
            rng = np.random.default_rng(0)
            while not stop.wait(0.05):
                picture = rng.integers(0, 255, (120, 160), dtype=np.uint8)
                server.publish(cv2.imencode(".jpg", picture)[1].tobytes())

        thread = threading.Thread(target=film, daemon=True)
        thread.start()
        code = call(
            monkeypatch,
            *("doctor", "--quick", "--port", emulator.url),
            *("--camera-url", server.url, "--camera", str(calibration)),
        )
        stop.set()
        thread.join()
    lines = capfd.readouterr().out.splitlines()
    assert code == 0, lines
    text = "\n".join(lines)
    for word in ("python", "pybullet", "p3dx-sh", "watchdog 2000 ms", "12.8 V", "160x120"):
        assert word in text
    assert not any(line.startswith("failure") for line in lines)
    assert emulator.pose == (0.0, 0.0, 0.0)
    assert "ENABLE 1" not in {str(command) for command in emulator.traffic.commands()}


def test_doctor_names_the_remedy(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    faults = FaultSchedule([Fault("low-battery", 10.2), Fault("estop")])
    with Emulator(Firmware(character("p3at-sh")), PtyPort(), faults) as emulator:
        assert call(monkeypatch, "doctor", "--quick", "--port", emulator.url) == 3
    out = capfd.readouterr().out
    assert "10.2 V -> charge it" in out
    assert "the emergency stop is pressed -> release it" in out
    assert call(monkeypatch, "doctor", "--quick", "--camera-url", "97") == 3
    assert "video devices here" in capfd.readouterr().out
