"""Ends a run whose plugin does not return although the time of its stage is over."""

from __future__ import annotations

import threading
import time
from types import TracebackType
from typing import Self

from visctrl.runtime.interrupts import Interrupts

#: How much longer than its stage a plugin may be at work (s).
GRACE_S = 5.0
_LOOK_S = 0.2


class PluginOverdueError(KeyboardInterrupt):
    """A plugin does not return; no failure of the plugin's own that it could catch."""


class CallLimit:
    """A thread that looks how long plugins take in a stage; used as a context.

    On the wall clock, a call may last until ``seconds`` and the grace after the stage's
    beginning, and not less than the grace. Where time stands still during a call, it alone may
    last so long. It ends as a signal would end it: nothing but the process itself can end a call
    that keeps the interpreter's lock, and nothing one outside the main thread.

    Parameters
    ----------
    seconds : float
        Longest duration of the stage.
    lockstep : bool
        Whether time stands still during calls.
    interrupts : Interrupts
        Ends the run.
    """

    def __init__(self, seconds: float, lockstep: bool, interrupts: Interrupts) -> None:
        self._seconds = seconds
        self._lockstep = lockstep
        self._interrupts = interrupts
        self._call: tuple[str, float] | None = None
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._look, name="call limit", daemon=True)

    def __enter__(self) -> Self:
        self._began = time.monotonic()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._closed.set()
        self._thread.join()

    def calling(self, who: str) -> None:
        """Note that a plugin is called; empty: it has returned."""
        self._call = (who, time.monotonic()) if who else None

    def _look(self) -> None:
        while not self._closed.wait(_LOOK_S):
            call = self._call
            if call is None:
                continue
            now, (who, since) = time.monotonic(), call
            end = (since if self._lockstep else self._began) + self._seconds
            if now > max(end, since) + GRACE_S:
                self._interrupts.end(
                    PluginOverdueError(
                        f"{who} does not return: for {now - since:.0f} s, in a stage of "
                        f"{self._seconds:g} s"
                    )
                )
                return
