"""The driver over real ports: pseudo-terminals, TCP, processes that are killed or frozen.

What depends on how fast this machine is carries the mark ``realtime``. The others may be as
late as they like: the emulated firmware keeps its own time.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from visctrl.hal.clock import WallClock
from visctrl.hal.emulator.emulator import Emulator
from visctrl.hal.emulator.firmware import Firmware
from visctrl.hal.emulator.firmware_profile import ARCOS, SIMULATOR, Personality, emulated, profile
from visctrl.hal.emulator.ports import Port, PtyPort, TcpPort
from visctrl.hal.errors import LinkError
from visctrl.hal.pioneer.base import PioneerBase
from visctrl.hal.pioneer.commands import Command, Id
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.robots import load_robot

ROOT = Path(__file__).parents[2]
#: Longest time that a process may take to start and get up to speed (s).
START_S = 60.0
#: A process that drives at full speed until it is killed.
DRIVER = """
import sys, time
from visctrl.hal.clock import WallClock
from visctrl.hal.pioneer.base import PioneerBase
from visctrl.hal.types import Velocity
from visctrl.robots import load_robot

base = PioneerBase(sys.argv[1], load_robot("p3dx"), load_robot("p3dx").operating, WallClock())
base.open()
while True:
    base.command(Velocity(0.4, 0.0))
    time.sleep(0.1)
"""


def make_base(url: str, *bauds: int) -> PioneerBase:
    robot = load_robot("p3dx")
    return PioneerBase(url, robot, robot.operating, WallClock(), bauds or (9600, 38400))


def make_emulator(port: Port, personality: Personality = ARCOS) -> Emulator:
    return Emulator(Firmware(profile(emulated("p3dx-sh"), personality)), port)


def wait_until(done: Callable[[], bool], limit: float = START_S) -> None:
    start = time.monotonic()
    while not done():
        assert time.monotonic() - start < limit, "it never happened"
        time.sleep(0.005)


@pytest.mark.realtime
@pytest.mark.parametrize(("port", "personality"), [(PtyPort, ARCOS), (TcpPort, SIMULATOR)])
def test_session(port: type[Port], personality: Personality) -> None:
    with make_emulator(port(), personality) as emulator:
        base = make_base(emulator.url)
        base.open()
        try:
            for _ in range(15):
                base.command(Velocity(0.3, math.radians(-20)))
                time.sleep(0.1)
            assert base.status().faults == ()
            assert emulator.velocity.v == pytest.approx(0.3)
        finally:
            base.close()
        assert emulator.velocity == STANDSTILL
        assert not emulator.motors
        assert math.dist(base.odometry().pose[:2], emulator.pose[:2]) < 0.01
        assert emulator.traffic.violations() == []


@contextmanager
def driving(emulator: Emulator) -> Iterator[subprocess.Popen[bytes]]:
    """A process that has got the robot up to full speed."""
    process = subprocess.Popen(
        [sys.executable, "-c", DRIVER, emulator.url], cwd=ROOT, stderr=subprocess.DEVNULL
    )
    try:
        wait_until(lambda: emulator.velocity.v == 0.4)
        yield process
    finally:
        process.kill()
        process.wait()


def test_killed_driver() -> None:
    """kill -9 at full speed: the firmware's watchdog acts, in its own time."""
    with make_emulator(PtyPort()) as emulator, driving(emulator) as process:
        process.kill()
        process.wait()
        dead = emulator.now()
        wait_until(lambda: emulator.standing_since is not None)
        last = emulator.traffic.entries[-1].latest
        assert last <= dead + 0.05  # nothing is left that feeds the watchdog
        assert emulator.standing_since is not None
        assert 1.9 < emulator.standing_since - last <= 2.1 + 0.05
        base = make_base(emulator.url)
        base.open()
        base.close()


@pytest.mark.realtime
def test_frozen_driver_does_not_revive_the_robot() -> None:
    """After a pause longer than the watchdog's, the first packet takes the set-point back."""
    with make_emulator(PtyPort()) as emulator, driving(emulator) as process:
        process.send_signal(signal.SIGSTOP)
        wait_until(lambda: emulator.standing_since is not None, 2.5)
        before = len(emulator.traffic.commands())
        process.send_signal(signal.SIGCONT)
        wait_until(lambda: len(emulator.traffic.commands()) > before + 1)
        assert emulator.traffic.commands()[before : before + 2] == [
            Command(Id.VEL, 0),
            Command(Id.RVEL, 0),
        ]


@pytest.mark.realtime
def test_rate_of_the_line_is_found() -> None:
    with make_emulator(PtyPort(38400)) as emulator:
        base = make_base(emulator.url)
        base.open()
        base.close()
        assert emulator.traffic.commands()


# --- ports that will not do ------------------------------------------------------------------


def open_error(url: str) -> str:
    base = make_base(url, 9600)
    with pytest.raises(LinkError) as caught:
        base.open()
    base.close()
    return str(caught.value)


def test_no_such_port() -> None:
    assert "no such port" in open_error("/dev/does-not-exist")
    assert "refused" in open_error("socket://127.0.0.1:1")
    assert "socket://HOST:PORT" in open_error("socket://127.0.0.1")
    assert "socket://HOST:PORT" in open_error("socket://127.0.0.1:x")
    assert "it is no serial port" in open_error("/dev/null")
    assert "it is no serial port" in open_error("/tmp")


def test_silent_port() -> None:
    master, slave = os.openpty()
    try:
        assert "silence" in open_error(os.ttyname(slave))
    finally:
        os.close(master)
        os.close(slave)


def test_port_that_echoes() -> None:
    assert "echo" in open_error("loop://")


def test_busy_port() -> None:
    with make_emulator(PtyPort()) as emulator:
        base = make_base(emulator.url)
        base.open()
        try:
            assert "in use" in open_error(emulator.url)
        finally:
            base.close()
