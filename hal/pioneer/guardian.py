"""Starts and feeds the process that stops the robot when this one cannot (dead man's switch)."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from visctrl.hal.pioneer.guardian_process import BEAT, FAREWELL, READY, STANDING

_PROGRAM = Path(__file__).with_name("guardian_process.py")
#: Longest time that the process may take to start, and to end (s).
_START_S, _END_S = 20.0, 5.0


class Guardian:
    """A process of its own that holds the line and writes stop packets to it.

    It does so when a moving robot has not been commanded for too long, and when this process
    ends without a farewell: whatever holds the interpreter's lock, suspends or kills this one.

    Parameters
    ----------
    line : int
        Descriptor of an open terminal or socket.
    stop : sequence of bytes
        Packets that stop the robot.
    timeout : float
        Greatest age of a command that moves the robot (s).

    Raises
    ------
    OSError
        It cannot be started, or does not begin to watch.
    """

    def __init__(self, line: int, stop: Sequence[bytes], timeout: float) -> None:
        self._timeout = timeout
        self._standing = True
        #: Whether it has ended, or does not listen any more.
        self.lost = False
        if os.name != "posix" or not sys.executable:
            raise OSError("processes cannot inherit a line here")
        # A session of its own: what a terminal sends to the group of this process spares it.
        # Isolated and without site packages, it starts at once.
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", str(_PROGRAM), str(line), *(each.hex() for each in stop)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
            cwd="/",
            pass_fds=(line,),
            start_new_session=True,
        )
        assert self._process.stdin is not None
        self._beats = self._process.stdin
        os.set_blocking(self._beats.fileno(), False)
        self._await_ready()

    def beat(self, *, moving: bool) -> bool:
        """Note that the robot is commanded: before it is to move, after it is to stand.

        Return whether the guardian listens.
        """
        self._standing = not moving
        self._write(time.monotonic() + self._timeout if moving else STANDING)
        return not self.lost

    def close(self) -> None:
        """Dismiss it; where the robot may still move, it stops it first. Safe to call twice."""
        if self._standing:
            self._write(FAREWELL)
        self._beats.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self.lost = True

    def _await_ready(self) -> None:
        answer = self._process.stdout
        assert answer is not None
        with answer:
            if select.select([answer], [], [], _START_S)[0] and answer.read(1) == READY:
                return
        self._process.kill()
        self.close()
        raise OSError("its process does not start")

    def _write(self, beat: float) -> None:
        if self.lost:
            return
        try:
            os.write(self._beats.fileno(), BEAT.pack(beat))
        except (OSError, ValueError):  # ended, full of beats that it has not read, or closed
            self.lost = True
