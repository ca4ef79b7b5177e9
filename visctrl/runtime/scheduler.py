"""When ticks happen: absolute deadlines on an injected steady clock."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from visctrl.hal.interfaces import Clock

#: A deadline missed by less than this share of the period is served late instead of skipped.
GRACE = 0.1
#: Longest time (s) that a thread keeps the interpreter from another one in a run in real time.
_SWITCH_S = 0.0005


class Tick(NamedTuple):
    """One turn of the loop.

    start : when it started (s on the clock).
    dt : time since the start of the previous one (s); the period for the first.
    lateness : how long after its deadline it started (s).
    skipped : deadlines given up before it because the previous tick was still at work.
    overslept : deadlines given up because the system did not wake us in time.
    """

    start: float
    dt: float
    lateness: float
    skipped: int
    overslept: int

    @property
    def missed(self) -> int:
        """Deadlines given up before this tick."""
        return self.skipped + self.overslept


class Ticker:
    """Waits for the deadlines ``origin + k · period``.

    A tick that overruns costs whole periods: the deadlines that passed meanwhile are given up
    and the next one is met on time, so that the phase stays.

    Parameters
    ----------
    clock : Clock
        Steady time; the first deadline is now.
    period : float
        Time between deadlines (s).
    """

    def __init__(self, clock: Clock, period: float) -> None:
        self._clock = clock
        self._period = period
        self._origin = clock.now()
        self._slot = 0
        self._previous_start: float | None = None

    @property
    def origin(self) -> float:
        """The first deadline (s on the clock)."""
        return self._origin

    def wait(self) -> Tick:
        """Sleep until the next deadline that can still be met and return the tick."""
        skipped = self._periods_past(self._clock.now(), GRACE)
        self._slot += skipped
        self._clock.sleep_until(self._deadline)
        start = self._clock.now()
        overslept = self._periods_past(start, 1.0)
        self._slot += overslept
        lateness = max(0.0, start - self._deadline)
        dt = self._period if self._previous_start is None else start - self._previous_start
        self._previous_start = start
        self._slot += 1
        return Tick(start, dt, lateness, skipped, overslept)

    @property
    def _deadline(self) -> float:
        return self._origin + self._slot * self._period

    def _periods_past(self, now: float, allowed: float) -> int:
        """Return how many deadlines to give up when the next one lies too far in the past.

        With up to ``allowed`` periods of delay it is none; else those before ``now``, up to the
        first that lies in the future (at the start of a tick: up to the last in the past).
        """
        behind = (now - self._deadline) / self._period
        if behind <= allowed:
            return 0
        return math.floor(behind) if allowed >= 1.0 else math.ceil(behind)


@contextmanager
def prompt_threads() -> Iterator[None]:
    """Let a waking thread wait for the interpreter no longer than `_SWITCH_S`.

    By default the threads of camera, base and recorder could each make a tick 5 ms late.
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
