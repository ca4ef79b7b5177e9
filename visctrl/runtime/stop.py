"""A wish from another thread that the run ends now: the STOP button's way to the base."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator


class StopRequested(KeyboardInterrupt):
    """Somebody wants the run to end."""


class StopRequest:
    """May be made once, by any thread, and is met by the run's own.

    Where the base may be stopped from another thread (`acting_at_once`), that happens before
    `make` returns, even while a plugin hangs; otherwise the next command that would move the
    robot is withheld (`check`), which is within one tick.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._reason = ""
        self._act: Callable[[], object] | None = None

    def make(self, reason: str) -> None:
        """Ask for the end; only the first reason counts."""
        with self._lock:
            self._reason = self._reason or reason
            if self._act is not None:
                # The loop meets a failure of the base itself with its own stop command.
                with contextlib.suppress(Exception):
                    self._act()

    @property
    def made(self) -> bool:
        """Whether anybody has asked."""
        return bool(self._reason)

    def check(self) -> None:
        """Raise `StopRequested` if anybody has asked."""
        if self._reason:
            raise StopRequested(self._reason)

    @contextlib.contextmanager
    def acting_at_once(self, stop: Callable[[], object]) -> Iterator[None]:
        """Have `make` call ``stop`` in the thread that makes the request, in this context."""
        with self._lock:
            self._act = stop
        try:
            yield
        finally:
            with self._lock:
                self._act = None
