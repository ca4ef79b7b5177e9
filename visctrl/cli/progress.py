"""Progress of a run on stderr: a line that is rewritten, or lines now and then in a log."""

from __future__ import annotations

import math
import time
from collections import deque
from types import TracebackType
from typing import ClassVar, Self

from rich.console import Console
from rich.status import Status

from visctrl.runtime.plan import Plan
from visctrl.runtime.records import Observer, TickRecord

#: How often the line is rewritten on a terminal, and added to a log (s of wall time).
_TERMINAL_S, _LOG_S = 0.2, 5.0
_RECENT = 50


class Progress(Observer):
    """Shows time, distance to go where it is known, features and the cost of a tick."""

    reads_signals: ClassVar[bool] = False

    def __init__(self, console: Console, plan: Plan, *, enabled: bool) -> None:
        self._console = console
        self._enabled = enabled
        self._duration = plan.scenario.duration_s
        self._status = Status("starting", console=console)
        self._every = _TERMINAL_S if console.is_terminal else _LOG_S
        self._shown_at = time.monotonic()
        self._costs: deque[float] = deque(maxlen=_RECENT)

    def __enter__(self) -> Self:
        if self._enabled and self._console.is_terminal:
            self._status.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._status.stop()

    def on_message(self, text: str) -> None:
        """Show what the session does."""
        self._show(text)

    def on_stage(self, stage: str) -> None:
        """Show that a stage begins."""
        self._show(f"{stage} stage")

    def on_tick(self, record: TickRecord) -> None:
        """Show a tick, if the last one has been shown long enough."""
        self._costs.append(sum(record.seconds))
        now = time.monotonic()
        if now - self._shown_at < self._every:
            return
        self._shown_at = now
        cost = 1000.0 * sorted(self._costs)[len(self._costs) // 2]
        parts = [
            f"{record.stage} {record.decision.phase}".rstrip(),
            f"{record.t:.1f} of at most {self._duration:g} s",
            f"{len(record.views)} features",
            f"tick {cost:.1f} ms",
        ]
        if record.truth is not None:
            togo = math.hypot(record.truth.x, record.truth.y)
            parts.insert(2, f"{togo:.2f} m and {abs(math.degrees(record.truth.phi)):.1f} deg to go")
        if record.event:
            parts.append(record.event)
        self._show(", ".join(parts))

    def _show(self, text: str) -> None:
        if not self._enabled:
            return
        if self._console.is_terminal:
            self._status.update(text)
        else:
            self._console.print(text, highlight=False, soft_wrap=True)
