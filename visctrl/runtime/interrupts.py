"""Signals that end a run, let through at once except where something must not be cut in two."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType, TracebackType
from typing import Any, Self

_EXIT_BASE = 128
#: Ctrl-C, a supervisor's wish, a lost terminal, Ctrl-\\, Ctrl-Z; as far as the system has them.
_ENDING = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")


class Interrupted(KeyboardInterrupt):
    """The user or the system wants the run to end.

    exit_code : 128 plus the number of the signal, as a shell reports it.
    """

    def __init__(self, number: int) -> None:
        self.signal = signal.Signals(number)
        self.exit_code = _EXIT_BASE + number
        what = "Ctrl-C" if self.signal is signal.SIGINT else self.signal.name
        super().__init__(f"stopped by {what}")


class Interrupts:
    """Turns the signals that end a run into `Interrupted` while it is entered as a context.

    A suspended process looks after no robot, so Ctrl-Z ends a run, too, unless it is
    ``suspendable`` (nothing moves while its time stands still). A lost terminal that is to be
    ignored (``nohup``) is ignored.

    ``with interrupts.shield:`` holds them back: a command to the base is finished first. After
    the first one, or after `ignore`, further ones change nothing: the end is under way.
    Outside the main thread, which alone gets signals, it does nothing.
    """

    def __init__(self, *, suspendable: bool = False) -> None:
        self.suspendable = suspendable
        self.shield = _Shield(self)
        self._depth = 0
        self._pending: int | None = None
        self._over = False
        self._error: BaseException | None = None
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in ending_signals():
                if signal.getsignal(number) != signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()

    def end(self, error: BaseException) -> None:
        """Raise ``error`` in the main thread, from another one, as a signal would.

        Nothing happens where signals are not looked after: outside the main thread, or where the
        system cannot send one to a thread.
        """
        main = threading.main_thread().ident
        if signal.SIGTERM in self._previous and main is not None:
            self._error = error
            if hasattr(signal, "pthread_kill"):
                signal.pthread_kill(main, signal.SIGTERM)

    def ignore(self) -> None:
        """Let nothing disturb the clean-up from here on."""
        self._over = True

    def _handle(self, number: int, frame: FrameType | None) -> None:
        del frame
        if number == getattr(signal, "SIGTSTP", None) and self.suspendable:
            os.kill(os.getpid(), signal.SIGSTOP)
            return
        if self._over:
            return
        if self._depth == 0:
            self._over = True
            raise self._error or Interrupted(number)
        self._pending = number

    def _enter_shield(self) -> None:
        self._depth += 1

    def _leave_shield(self, failing: bool) -> None:
        self._depth -= 1
        if self._depth == 0 and self._pending is not None and not failing:
            self._over = True
            raise self._error or Interrupted(self._pending)


def ending_signals() -> list[signal.Signals]:
    """Return the signals that end a run, as far as the system has them."""
    return [signal.Signals[name] for name in _ENDING if name in signal.Signals.__members__]


class _Shield:
    def __init__(self, owner: Interrupts) -> None:
        self._owner = owner

    def __enter__(self) -> None:
        self._owner._enter_shield()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._owner._leave_shield(failing=kind is not None)
