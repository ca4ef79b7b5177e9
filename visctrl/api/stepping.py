"""A run tick by tick: frames, views, estimates and decisions as they come."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from queue import Queue
from types import TracebackType
from typing import Self

from visctrl.api.results import Run
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.stop import StopRequest


class Session:
    """A run that waits after every tick until it is told to go on.

    Only simulated time can wait; on the wall clock a robot that nobody steps is stopped by its
    watchdog. Leaving the context ends the run: the robot stops, its files are written.

    >>> import visctrl
    >>> with visctrl.session("mock", seed=1) as session:
    ...     first = session.step()
    >>> first.number, len(first.views) > 20
    (0, True)

    Parameters
    ----------
    begin : callable
        Runs to the end with the observer and the stop request that it is given.
    """

    def __init__(self, begin: Callable[[Observer, StopRequest], Run]) -> None:
        self._stop = StopRequest()
        self._gate = _Gate()
        self._over: Run | None = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, args=(begin,), daemon=True)
        self._started = False

    @property
    def run(self) -> Run | None:
        """The run once it is over."""
        return self._over

    def step(self) -> TickRecord | None:
        """Do one tick and return it; None when the run is over.

        Raises
        ------
        InputError
            Something cannot be used, found before the robot was told anything.
        """
        if self._started:
            self._gate.go.put(None)
        else:
            self._started = True
            self._thread.start()
        record = self._gate.done.get() if self._over is None and self._error is None else None
        if record is None and self._error is not None:
            raise self._error
        return record

    def __iter__(self) -> Iterator[TickRecord]:
        """Yield tick after tick to the run's end."""
        while (record := self.step()) is not None:
            yield record

    def close(self) -> Run | None:
        """End the run if it is not over; return it, None if it never began."""
        if self._thread.is_alive():
            self._stop.make("the session was closed")
            self._gate.open()
            self._thread.join()
        return self._over

    def _work(self, begin: Callable[[Observer, StopRequest], Run]) -> None:
        try:
            self._over = begin(self._gate, self._stop)
        except BaseException as error:
            self._error = error
        finally:
            self._gate.done.put(None)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class _Gate(Observer):
    """Hands over each tick and waits for the word to go on."""

    def __init__(self) -> None:
        self.done: Queue[TickRecord | None] = Queue()
        self.go: Queue[None] = Queue()
        self._open = False

    def open(self) -> None:
        """Wait no more."""
        self._open = True
        self.go.put(None)

    def on_tick(self, record: TickRecord) -> None:
        """Hand over a tick."""
        if not self._open:
            self.done.put(record)
            self.go.get()
