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
from visctrl.hal.pioneer.link import Link
from visctrl.hal.pioneer.settings import BRAKE
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.robots import load_robot

ROOT = Path(__file__).parents[2]
#: Longest time that a process may take to start and get up to speed (s).
START_S = 60.0
#: A process that drives at full speed until it is killed.
DRIVER = """
import re, signal, sys, time
from visctrl.hal.clock import WallClock
from visctrl.hal.pioneer.base import PioneerBase
from visctrl.hal.types import Velocity
from visctrl.robots import load_robot

# Told to, it looks for a pattern for ages, without giving the interpreter's lock away.
signal.signal(signal.SIGUSR1, lambda *_: re.match(r"(a+)+$", "a" * 60 + "b"))
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
    """kill -9 at full speed: the guardian acts, and leaves the line to the next one."""
    with make_emulator(PtyPort()) as emulator, driving(emulator) as process:
        process.kill()
        process.wait()
        wait_until(lambda: emulator.standing_since is not None)
        assert emulator.standing_since is not None
        wait_until(lambda: free(emulator.url))
        # It was not left to the firmware's watchdog.
        assert emulator.traffic.commands()[-len(BRAKE) :] == list(BRAKE)
        base = make_base(emulator.url)
        base.open()
        base.close()
        assert emulator.traffic.violations() == []


def free(url: str) -> bool:
    """Return whether nobody holds a terminal."""
    link = Link(url, WallClock())
    try:
        link.open()
    except LinkError:
        return False
    link.close()
    return True


@pytest.mark.realtime
@pytest.mark.parametrize("port", [PtyPort, TcpPort])
@pytest.mark.parametrize("end", ["kill", "hold"])
def test_unable_to_stop_by_itself(port: type[Port], end: str) -> None:
    """Killed, or with the interpreter's lock held for ages: the robot stands within 0.6 s."""
    with make_emulator(port()) as emulator, driving(emulator) as process:
        began, where = emulator.now(), emulator.pose
        if end == "kill":
            process.kill()
        else:
            process.send_signal(signal.SIGUSR1)
        wait_until(lambda: emulator.standing_since is not None)
        assert emulator.standing_since is not None
        assert emulator.standing_since - began <= 0.6
        assert math.dist(where[:2], emulator.pose[:2]) < 0.25
        assert (process.poll() is None) == (end == "hold")


def test_guardian_that_is_gone_ends_the_drive() -> None:
    """Without it, nothing more is driven."""
    with make_emulator(PtyPort()) as emulator:
        base = make_base(emulator.url)
        base.open()
        try:
            base.command(Velocity(0.3, 0.0))
            guardian = base._link._guardian
            assert guardian is not None
            guardian._process.kill()
            guardian._process.wait()
            with pytest.raises(LinkError, match="guards the robot has ended"):
                base.command(Velocity(0.3, 0.0))
        finally:
            base.close()
        assert emulator.velocity == STANDSTILL


def test_line_that_cannot_be_shared(caplog: pytest.LogCaptureFixture) -> None:
    link = Link("loop://", WallClock())
    link.open()
    link.guard(BRAKE, 0.4)
    link.beat(moving=True)
    link.close()
    assert "only the robot's own watchdog" in caplog.text


@pytest.mark.realtime
def test_frozen_driver_does_not_revive_the_robot() -> None:
    """Frozen at full speed, the guardian stops it; when it goes on, it takes the set-point back."""
    with make_emulator(PtyPort()) as emulator, driving(emulator) as process:
        process.send_signal(signal.SIGSTOP)
        wait_until(lambda: emulator.standing_since is not None, 0.7)
        time.sleep(2.2)
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
