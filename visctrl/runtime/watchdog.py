"""Stops a robot whose commands stop coming, while the loop itself hangs in a plugin."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self


class Watchdog:
    """A thread that stops the base when the command in force grows old; used as a context.

    It is the one thing that acts while a plugin does not return. Commands to the base are sent
    with ``lock`` held, so that a stop never cuts into one.

    Parameters
    ----------
    stop : callable
        Stops the base.
    timeout : float
        Greatest age of a command that moves the robot (s).
    """

    def __init__(self, stop: Callable[[], object], timeout: float) -> None:
        self._stop = stop
        self._timeout = timeout
        self._expires: float | None = None
        self._closed = False
        self.lock = threading.RLock()
        self._changed = threading.Condition(self.lock)
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def feed(self, *, moving: bool) -> None:
        """Note a new command; one that keeps the robot still never grows old."""
        with self._changed:
            self._expires = time.monotonic() + self._timeout if moving else None
            self._changed.notify()

    def act(self) -> None:
        """Stop the base now, from any thread."""
        with self._changed:
            self._expires = None
            self._stop()

    def _watch(self) -> None:
        with self._changed:
            while not self._closed:
                left = None if self._expires is None else self._expires - time.monotonic()
                if left is None or left > 0.0:
                    self._changed.wait(left)
                    continue
                # The loop meets a failure of the base itself as soon as it goes on.
                with contextlib.suppress(Exception):
                    self.act()
