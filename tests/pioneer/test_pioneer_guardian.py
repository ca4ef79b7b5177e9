"""The guardian alone: a pipe of beats on one side, a socket in the place of the robot's line."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visctrl.hal.pioneer import guardian_process
from visctrl.hal.pioneer.guardian import Guardian
from visctrl.hal.pioneer.guardian_process import BEAT, FAREWELL, STANDING, watch
from visctrl.hal.pioneer.packet import StreamDecoder
from visctrl.hal.pioneer.settings import BRAKE

STOP = [each.encode() for each in BRAKE]
#: Longer than anything here should take (s), however busy the machine.
PATIENCE_S = 30.0
AN_HOUR_S = 3600.0
#: A process that kills itself and its whole group while the robot drives.
DRIVER = """
import os, signal, sys
from visctrl.hal.pioneer.guardian import Guardian
from visctrl.hal.pioneer.settings import BRAKE

guardian = Guardian(int(sys.argv[1]), [each.encode() for each in BRAKE], 3600.0)
guardian.beat(moving=True)
os.killpg(0, signal.SIGKILL)
"""


class Line:
    """The robot's end of a line, and the driver's."""

    def __init__(self) -> None:
        self.driver, self.robot = socket.socketpair()
        self.robot.settimeout(PATIENCE_S)

    def close(self) -> None:
        self.driver.close()
        self.robot.close()

    def heard_at_last(self) -> bytes:
        """Return all that was sent until nobody holds the driver's end any more."""
        heard = b""
        while data := self.robot.recv(4096):
            heard += data
        return heard


@pytest.fixture
def line() -> Iterator[Line]:
    it = Line()
    yield it
    it.close()


def packets(data: bytes) -> list[bytes]:
    return [packet.encode() for packet in StreamDecoder().feed(data, 0.0)]


def test_dismissed_while_the_robot_stands_it_says_nothing(line: Line) -> None:
    guardian = Guardian(line.driver.fileno(), STOP, AN_HOUR_S)
    assert guardian.beat(moving=True)
    assert guardian.beat(moving=False)
    guardian.close()
    guardian.close()
    line.driver.close()
    assert line.heard_at_last() == b""


def test_a_robot_that_is_left_driving_is_stopped(line: Line) -> None:
    guardian = Guardian(line.driver.fileno(), STOP, AN_HOUR_S)
    assert guardian.beat(moving=True)
    guardian.close()
    line.driver.close()
    heard = packets(line.heard_at_last())
    assert heard[:3] == STOP
    assert set(heard) == set(STOP)
    assert not guardian.beat(moving=True)


def test_an_overdue_beat_stops_the_robot_and_the_guard_goes_on(line: Line) -> None:
    guardian = Guardian(line.driver.fileno(), STOP, 0.05)
    try:
        for _ in range(2):
            assert guardian.beat(moving=True)
            heard = b""
            while len(packets(heard)) < 9:
                heard += line.robot.recv(4096)
            assert packets(heard) == 3 * STOP
    finally:
        guardian.close()


def test_killed_with_its_whole_group() -> None:
    """What a terminal or a supervisor sends to the group does not reach the guardian."""
    line = Line()
    try:
        number = line.driver.fileno()
        done = subprocess.run(
            [sys.executable, "-c", DRIVER, str(number)],
            cwd=Path(__file__).parents[2],
            pass_fds=(number,),
            start_new_session=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert done.returncode == -9
        line.driver.close()
        assert packets(line.heard_at_last())[:3] == STOP
    finally:
        line.close()


def test_a_guardian_that_is_killed_is_missed(line: Line) -> None:
    guardian = Guardian(line.driver.fileno(), STOP, AN_HOUR_S)
    guardian._process.kill()
    guardian._process.wait()
    assert not guardian.beat(moving=True)
    assert guardian.lost
    guardian.close()


def test_what_cannot_be_started_says_so(line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(OSError, match="does not start"):
        Guardian(line.driver.fileno(), STOP, AN_HOUR_S)


@settings(deadline=None, max_examples=60)
@given(st.lists(st.sampled_from([STANDING, AN_HOUR_S, 0.0]), max_size=600), st.booleans())
def test_only_the_newest_beat_counts(beats: list[float], dismissed: bool) -> None:
    """Beats that have waited in the pipe: an old one that is overdue is no reason to stop."""
    now = time.monotonic()
    data = b"".join(BEAT.pack(now + beat) for beat in beats)
    line, (reading, writing) = Line(), os.pipe()
    os.write(writing, data + BEAT.pack(FAREWELL) * dismissed)
    os.close(writing)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guardian_process, "_SPACING_S", 0.0)
        watch(reading, line.driver.fileno(), STOP)
    os.close(reading)
    line.driver.close()
    heard = packets(line.heard_at_last())
    line.close()
    # What fits into one reading is judged as one.
    if len(data) + BEAT.size <= 4096:
        assert heard == ([] if dismissed else 3 * STOP)
    else:
        assert len(heard) % 9 == 0
        assert dismissed or heard[-9:] == 3 * STOP
