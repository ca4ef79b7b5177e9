"""The driver against the emulator, over real ports and in real time."""

from __future__ import annotations

import itertools
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import serial

from hal.clock import ManualClock, WallClock
from hal.errors import InputError, LinkError
from hal.pioneer.base import PioneerBase
from hal.pioneer.commands import Command, Id
from hal.pioneer.emulator.character import ARCOS, SIMULATOR, Personality, character
from hal.pioneer.emulator.emulator import Emulator
from hal.pioneer.emulator.firmware import Firmware
from hal.pioneer.emulator.ports import PtyPort
from hal.pioneer.link import SPACING_S, Link
from hal.pioneer.subclasses import SUBCLASSES
from hal.types import Velocity
from robots import load_robot

MakeBench = Callable[..., Any]
pytestmark = pytest.mark.realtime
ROOT = Path(__file__).parents[2]

#: Longest time that a process may take to start and get up to speed (s).
START_S = 60.0
#: A process that drives at full speed until it is killed.
DRIVER = """
import sys, time
from hal.clock import WallClock
from hal.pioneer.base import PioneerBase
from hal.types import Velocity
from robots import load_robot

base = PioneerBase(sys.argv[1], "p3dx", load_robot("p3dx").operating, WallClock())
base.open()
while True:
    base.command(Velocity(0.4, 0.0))
    print("driving", flush=True)
    time.sleep(0.1)
"""


def wait_until(done: Callable[[], bool], limit: float) -> float:
    start = time.monotonic()
    while not done():
        assert time.monotonic() - start < limit, "it never happened"
        time.sleep(0.005)
    return time.monotonic() - start


@pytest.mark.parametrize(("kind", "personality"), [("pty", ARCOS), ("tcp", SIMULATOR)])
def test_session(bench: MakeBench, kind: str, personality: Personality) -> None:
    it = bench(kind, personality=personality)
    base = it.base()
    base.open()
    assert it.emulator.motors
    assert base.status().faults == ()
    assert base.status().battery_v == pytest.approx(12.8)
    sent = it.drive(base, Velocity(0.3, math.radians(-20)), 1.5)
    assert sent == (0.3, math.radians(-20))
    velocity = it.emulator.velocity
    assert velocity.v == pytest.approx(0.3)
    assert velocity.omega == pytest.approx(math.radians(-20))
    wait_until(lambda: len(base.echoes()) == 16, 0.5)
    assert set(base.echoes().values()) == {5.0}
    base.close()
    base.close()
    odometry, truth = base.odometry().pose, it.emulator.pose
    assert math.dist(odometry[:2], truth[:2]) < 0.01
    assert odometry.phi == pytest.approx(truth.phi, abs=math.radians(0.6))
    assert it.emulator.velocity == (0.0, 0.0)
    assert not it.emulator.motors
    assert it.emulator.traffic.violations() == []
    with pytest.raises(LinkError, match="not connected"):
        base.command(Velocity(0.1, 0.0))


def test_signs_and_whole_units(bench: MakeBench) -> None:
    it = bench(subclass="p3at-sh")
    base = it.base("p3at")
    base.open()
    try:
        sent = base.command(Velocity(-0.12345, 0.3))
        assert sent == (-0.123, math.radians(17))
        limits = load_robot("p3at").operating
        clipped = base.command(Velocity(10.0 * limits.v_m_s, limits.omega_rad_s))
        assert clipped.v == limits.v_m_s
        assert clipped.omega == pytest.approx(limits.omega_rad_s / 10.0, abs=math.radians(0.5))
        with pytest.raises(ValueError, match="finite"):
            base.command(Velocity(math.nan, 0.0))
    finally:
        base.close()
    commands = [str(command) for command in it.emulator.traffic.commands()]
    assert "VEL -123" in commands
    assert "RVEL 17" in commands


def test_rate_of_the_line_is_found() -> None:
    with Emulator(Firmware(character("p3dx-sh")), PtyPort(38400)) as emulator:
        limits = load_robot("p3dx").operating
        base = PioneerBase(emulator.url, "p3dx", limits, WallClock())
        base.open()
        base.close()
        assert emulator.traffic.commands()


def test_robot_left_open_and_moving_is_stopped_first(bench: MakeBench) -> None:
    it = bench()
    with serial.Serial(it.emulator.url, timeout=0.2) as port:
        for number in (Id.PULSE, Id.OPEN, Id.CLOSE, Id.OPEN):
            port.write(Command(number).encode())
            time.sleep(0.01)
        for command in (Command(Id.ENABLE, 1), Command(Id.VEL, 400)):
            port.write(command.encode())
            time.sleep(0.01)
        time.sleep(0.7)
    before = len(it.emulator.traffic.commands())
    assert it.emulator.velocity.v > 0.1
    base = it.base()
    base.open()
    try:
        assert it.emulator.traffic.commands()[before] == Command(Id.CLOSE)
        assert it.emulator.velocity == (0.0, 0.0)
    finally:
        base.close()


def test_nobody_commands_a_moving_robot(bench: MakeBench) -> None:
    it = bench()
    base = it.base()
    base.open()
    try:
        it.get_up_to(base, Velocity(0.4, 0.5))
        assert it.standstill_after(0.6) > 0.2
        time.sleep(2.3)  # longer than the watchdog: the driver feeds it, the robot stands
        assert it.emulator.velocity == (0.0, 0.0)
        it.drive(base, Velocity(0.2, 0.0), 0.5)
        assert it.emulator.velocity.v > 0.05
    finally:
        base.close()
    assert it.emulator.traffic.violations() == []


def test_killed_driver(bench: MakeBench) -> None:
    it = bench()
    process = subprocess.Popen(
        [sys.executable, "-c", DRIVER, it.emulator.url], cwd=ROOT, stdout=subprocess.PIPE
    )
    try:
        wait_until(lambda: it.emulator.velocity.v == 0.4, START_S)
        process.kill()
        killed = it.emulator.now()
        process.wait()
        assert it.standstill_after(2.1) > 1.0
        assert it.emulator.traffic.entries[-1].latest < killed + 0.05
    finally:
        process.kill()
        process.wait()
    it.next_run_works()


def test_frozen_driver_does_not_revive_the_robot(bench: MakeBench) -> None:
    """After a pause longer than the watchdog's, the first packet takes the set-point back."""
    it = bench()
    process = subprocess.Popen(
        [sys.executable, "-c", DRIVER, it.emulator.url],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    try:
        wait_until(lambda: it.emulator.velocity.v == 0.4, START_S)
        process.send_signal(signal.SIGSTOP)
        it.standstill_after(2.2)
        before = len(it.emulator.traffic.commands())
        process.send_signal(signal.SIGCONT)
        wait_until(lambda: len(it.emulator.traffic.commands()) > before + 1, 1.0)
        assert it.emulator.traffic.commands()[before : before + 2] == [
            Command(Id.VEL, 0),
            Command(Id.RVEL, 0),
        ]
    finally:
        process.kill()
        process.wait()


# --- ports and robots that will not do -----------------------------------------------


def open_error(url: str, kind: type[Exception] = LinkError) -> str:
    base = PioneerBase(url, "p3dx", load_robot("p3dx").operating, WallClock(), (9600,))
    with pytest.raises(kind) as caught:
        base.open()
    base.close()
    return str(caught.value)


def test_no_such_port() -> None:
    assert "no such port" in open_error("/dev/does-not-exist")
    assert "refused" in open_error("socket://127.0.0.1:1")


def test_silent_port() -> None:
    master, slave = os.openpty()
    try:
        assert "silence" in open_error(os.ttyname(slave))
    finally:
        os.close(master)
        os.close(slave)


def test_port_that_echoes() -> None:
    assert "echo" in open_error("loop://")


def test_busy_port(bench: MakeBench) -> None:
    it = bench()
    base = it.base()
    base.open()
    try:
        assert "in use" in open_error(it.emulator.url)
    finally:
        base.close()


def test_rubbish(bench: MakeBench) -> None:
    it = bench()
    it.emulator.faults.switch_on("rubbish")
    assert "noise" in open_error(it.emulator.url)


def test_another_robot_than_expected(bench: MakeBench) -> None:
    it = bench(subclass="p3at-sh")
    assert "--robot p3at" in open_error(it.emulator.url, InputError)
    assert not it.emulator.motors


def test_unknown_subclass(bench: MakeBench, monkeypatch: pytest.MonkeyPatch) -> None:
    it = bench()
    monkeypatch.delitem(SUBCLASSES, "p3dx-sh")
    message = open_error(it.emulator.url)
    assert "'p3dx-sh'" in message
    assert "known: p2at" in message
    assert not it.emulator.motors
    assert it.emulator.traffic.commands()[-1] == Command(Id.CLOSE)


# --- pacing, on a clock moved by hand --------------------------------------------------


def test_commands_keep_their_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = ManualClock()
    link = Link("loop://", clock)
    link.open()
    times: list[float] = []
    port = link._port
    assert port is not None
    monkeypatch.setattr(port, "write", lambda data: times.append(clock.now()))
    link.send(*(Command(Id.PULSE) for _ in range(5)))
    clock.advance(1.0)
    link.send(Command(Id.PULSE), Command(Id.PULSE))
    gaps = [b - a for a, b in itertools.pairwise(times)]
    assert gaps == pytest.approx([SPACING_S] * 4 + [1.0] + [SPACING_S])
    link.close()
