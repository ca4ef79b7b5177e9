"""Whether the machine kept time: the worst lateness of a thread that only sleeps."""

from __future__ import annotations

import threading
import time

#: Waking up later than this (s) spoils a test in real time, whatever is tested.
STALL_S = 0.12
_SAMPLE_S = 0.01


class Stopwatch:
    """Samples lateness in the background, from its first use on."""

    def __init__(self) -> None:
        self._late: list[tuple[float, float]] = []
        self._since = 0.0
        self._thread: threading.Thread | None = None

    def begin(self) -> None:
        """Start looking from now."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, daemon=True)
            self._thread.start()
        self._since = time.monotonic()

    def look_back_to(self, t: float) -> None:
        """Count stalls since an earlier time (s, monotonic), when the tested thing began."""
        self._since = min(self._since, t)

    def worst(self) -> float:
        """Return the worst lateness (s) in what is looked at."""
        return max((late for t, late in self._late if t >= self._since), default=0.0)

    def _run(self) -> None:
        before = time.monotonic()
        while True:
            time.sleep(_SAMPLE_S)
            now = time.monotonic()
            late = now - before - _SAMPLE_S
            if late > STALL_S / 2:
                self._late.append((now, late))
            before = now


STOPWATCH = Stopwatch()
