"""Clocks: the wall, a simulated world's, and one that tests move by hand."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from visctrl.hal.interfaces import Clock


class WallClock(Clock):
    """Steady seconds since the clock was made."""

    def __init__(self) -> None:
        self._origin = time.monotonic()

    def now(self) -> float:
        """Return the seconds since the clock was made."""
        return time.monotonic() - self._origin

    def sleep_until(self, deadline: float) -> None:
        """Sleep until ``deadline`` (s), or return at once if it has passed."""
        remaining = deadline - self.now()
        while remaining > 0.0:
            time.sleep(remaining)
            remaining = deadline - self.now()


class WorldClock(Clock):
    """The time of a simulated world, which it advances.

    Lock-stepped, the world moves only while somebody sleeps: results do not depend on how long
    work takes. Following another clock, it is brought up to that clock's time whenever somebody
    looks, so late work is really late: devices call `synchronise` before they look at the world
    or change it.

    Parameters
    ----------
    advance : callable
        Moves the world on by so many seconds.
    follow : Clock or None
        The wall clock, starting with the world at zero; None is lock-step.
    """

    def __init__(self, advance: Callable[[float], None], follow: Clock | None = None) -> None:
        self._advance = advance
        self._wall = follow
        self._time = 0.0
        self._lock = threading.RLock()
        self.lockstep = follow is None

    def now(self) -> float:
        """Return the followed clock's time (s), or the world's if it is lock-stepped."""
        return self._time if self._wall is None else self._wall.now()

    def sleep_until(self, deadline: float) -> None:
        """Bring the world to ``deadline`` (s), asleep meanwhile if it follows a clock."""
        if self._wall is None:
            self._advance_to(deadline)
        else:
            self._wall.sleep_until(deadline)
            self.synchronise()

    def synchronise(self) -> float:
        """Bring the world up to now and return that time (s)."""
        if self._wall is not None:
            self._advance_to(self._wall.now())
        return self._time

    def _advance_to(self, t: float) -> None:
        with self._lock:
            if t > self._time:
                self._advance(t - self._time)
                self._time = t


class ManualClock(Clock):
    """Moves only when told to: for tests of code that keeps time."""

    def __init__(self) -> None:
        self._time = 0.0

    def now(self) -> float:
        """Return the time (s)."""
        return self._time

    def sleep_until(self, deadline: float) -> None:
        """Jump to ``deadline`` (s) unless it has passed."""
        self._time = max(self._time, deadline)

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        self._time += seconds
