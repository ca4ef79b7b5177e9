"""``visctrl drive``: the robot from the keyboard, while a key is held."""

from __future__ import annotations

import math
import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Protocol

from rich.console import Console

from visctrl.hal.clock import WallClock
from visctrl.hal.interfaces import Clock
from visctrl.hal.pioneer.base import PioneerBase
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.robots import load_robot
from visctrl.robots.errors import InputError
from visctrl.runtime.interrupts import Interrupts

#: Without a key for so long, the robot stops. Keyboards repeat a held key faster than this, but
#: begin to do so later: the robot moves a little, pauses, and goes on.
HOLD_S = 0.35
_PERIOD_S = 0.1
_POLL_S = 0.02

_MOVES = {
    "w": (1, 0),
    "s": (-1, 0),
    "a": (0, 1),
    "d": (0, -1),
    "\x1b[A": (1, 0),
    "\x1b[B": (-1, 0),
    "\x1b[D": (0, 1),
    "\x1b[C": (0, -1),
}
_FASTER, _SLOWER, _STOP, _QUIT = "+", "-", " ", "q"
_STEP = 1.25
_HELP = "arrows or w a s d: drive while held | space: stop | + -: faster, slower | q: quit"


class Keys(Protocol):
    """Where key presses come from."""

    def pressed(self) -> list[str]:
        """Return the keys pressed since the last call, without waiting."""


def drive(port: str, robot: str, speed: float, turn_deg: float) -> int:
    """Connect and drive until ``q`` or Ctrl-C.

    Raises
    ------
    InputError, DeviceError
        There is no keyboard or no robot, or the speeds are more than the robot may do.
    """
    its = load_robot(robot)
    limits = its.operating
    if not (0.0 < speed <= limits.v_m_s and 0.0 < turn_deg <= limits.omega_deg_s):
        raise InputError(
            f"--speed and --turn: at most {limits.v_m_s:g} m/s and {limits.omega_deg_s:g} deg/s"
        )
    clock = WallClock()
    base = PioneerBase(port, its, limits, clock)
    with Interrupts(), keyboard() as keys:
        try:
            base.open()
            Hand(base, keys, clock, Velocity(speed, math.radians(turn_deg))).run()
        finally:
            base.close()
    return 0


class Hand:
    """Turns key presses into velocities.

    Parameters
    ----------
    base : PioneerBase
        Open.
    keys : Keys
        Where key presses come from.
    clock : Clock
        Of the dead man's switch.
    speeds : Velocity
        What a held key asks for.
    """

    def __init__(self, base: PioneerBase, keys: Keys, clock: Clock, speeds: Velocity) -> None:
        self._base = base
        self._keys = keys
        self._clock = clock
        self._speeds = speeds
        self._scale = 1.0
        self._wanted = STANDSTILL
        self._pressed_at = -math.inf
        self._console = Console(stderr=True)

    def run(self) -> None:
        """Drive until the user quits."""
        self._console.print(_HELP)
        due = self._clock.now()
        with self._console.status("") as line:
            while self._listen():
                now = self._clock.now()
                if now >= due:
                    due = now + _PERIOD_S
                    sent = self._base.command(self._held(now))
                    line.update(self._describe(sent))
                self._clock.sleep_until(now + _POLL_S)
        self._base.stop()

    def _listen(self) -> bool:
        """Take key presses; return whether to go on."""
        for key in self._keys.pressed():
            if key == _QUIT:
                return False
            if key == _STOP:
                self._wanted = STANDSTILL
                self._base.stop()
            elif key in (_FASTER, _SLOWER):
                factor = _STEP if key == _FASTER else 1.0 / _STEP
                self._scale = min(1.0, max(0.1, self._scale * factor))
            elif key in _MOVES:
                v, omega = _MOVES[key]
                self._wanted = Velocity(v * self._speeds.v, omega * self._speeds.omega)
                self._pressed_at = self._clock.now()
        return True

    def _held(self, now: float) -> Velocity:
        if now - self._pressed_at > HOLD_S:
            return STANDSTILL
        return Velocity(self._scale * self._wanted.v, self._scale * self._wanted.omega)

    def _describe(self, sent: Velocity) -> str:
        status, pose = self._base.status(), self._base.odometry().pose
        ranges = self._base.echoes()
        parts = [
            f"{sent.v:+.2f} m/s {math.degrees(sent.omega):+3.0f} deg/s",
            f"at x {pose.x:+.2f} y {pose.y:+.2f} m, {math.degrees(pose.phi):+4.0f} deg",
            f"battery {status.battery_v:.1f} V" if status.battery_v is not None else "",
            f"nearest echo {min(ranges.values()):.2f} m" if ranges else "",
            *status.faults,
        ]
        return " | ".join(part for part in parts if part)


@contextmanager
def keyboard() -> Iterator[Keys]:
    """Read single keys from the terminal, which is as before afterwards.

    Raises
    ------
    InputError
        Standard input is no terminal, or the system has none.
    """
    try:
        import termios
        import tty
    except ImportError:
        raise InputError("driving by hand needs a POSIX terminal") from None
    if not sys.stdin.isatty():
        raise InputError("driving by hand needs a terminal: standard input is not one")
    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    try:
        tty.setcbreak(number)
        yield _Terminal(number)
    finally:
        with suppress(termios.error):  # the terminal may have gone
            termios.tcsetattr(number, termios.TCSADRAIN, before)


class _Terminal:
    def __init__(self, number: int) -> None:
        self._number = number

    def pressed(self) -> list[str]:
        """Return the keys pressed since the last call."""
        text = ""
        while select.select([self._number], [], [], 0.0)[0]:
            try:
                data = os.read(self._number, 256)
            except OSError:
                data = b""
            if not data:
                return [*split_keys(text), _QUIT]  # the terminal has gone
            text += data.decode(errors="ignore")
        return split_keys(text)


def split_keys(text: str) -> list[str]:
    """Return the keys in what a terminal sent; an arrow is three characters."""
    keys = []
    while text:
        size = 3 if text.startswith("\x1b[") and len(text) >= 3 else 1
        keys.append(text[:size])
        text = text[size:]
    return keys
