"""Progress of a study on stderr: a bar with rate and time left, or lines in a log."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

_LOG_EVERY_S = 5.0


class StudyProgress:
    """Shows how many runs are checked and done.

    Parameters
    ----------
    console : Console
        On a terminal a bar is rewritten; else a line is added now and then.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            _Rate(),
            TextColumn("{task.fields[pace]}"),
            TimeRemainingColumn(),
        )
        self._bar = Progress(*columns, console=console, disable=not console.is_terminal)
        self._task = self._bar.add_task("checking", total=None, pace="")

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def checked(self, total: int, done: int) -> None:
        """Show how many scenarios are checked."""
        self._bar.update(self._task, total=total, completed=done)

    def ran(self, total: int) -> Callable[[int, float], None]:
        """Return what takes the number of finished runs out of ``total``, and their time (s)."""
        self._bar.remove_task(self._task)
        task: list[TaskID] = []
        lines = _Lines(self._console, total)

        def show(done: int, simulated: float) -> None:
            if not task:  # those of an earlier call say nothing about the rate
                task.append(self._bar.add_task("runs", total=total, completed=done, pace=""))
            pace = lines.show(done, simulated)
            self._bar.update(task[0], completed=done, pace=pace)

        return show


class _Lines:
    """How fast it goes, and lines in a log, where a bar cannot be rewritten."""

    def __init__(self, console: Console, total: int) -> None:
        self._console = console
        self._total = total
        self._first: tuple[int, float, float] | None = None
        self._shown_at = -_LOG_EVERY_S

    def show(self, done: int, simulated: float) -> str:
        """Add a line now and then; return how many times faster than real time it goes."""
        now = time.monotonic()
        self._first = self._first or (done, simulated, now)
        before, lived, began = self._first
        pace = f"{(simulated - lived) / (now - began):,.0f} x real time" if done > before else ""
        finished = done == self._total
        if self._console.is_terminal or (now - self._shown_at < _LOG_EVERY_S and not finished):
            return pace
        self._shown_at = now
        text = f"{done} of {self._total} runs"
        if done > before:
            rate = (done - before) / (now - began)
            text += f", {rate:.2f} a second, {pace}, {(self._total - done) / rate:.0f} s left"
        self._console.print(text, highlight=False, soft_wrap=True)
        return pace


class _Rate(ProgressColumn):
    """Runs a second."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.2f}/s")
