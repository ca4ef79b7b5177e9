"""What a table or figure is made of: an entry runs its cases and compares each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from visctrl.reproduce.recorded_run import drive
from visctrl.study.batch import run_all
from visctrl.study.run_spec import RunSpec


@dataclass(frozen=True)
class Row:
    """One case: the published numbers, ours, and whether ours are at least as good.

    A key says its unit, and means the same in both mappings. ``published`` may hold a bound
    that the project sets itself where the source gives no number; the entry's title says so.
    """

    case: str
    published: Mapping[str, float]
    ours: Mapping[str, float]
    ok: bool

    def as_dict(self) -> dict[str, Any]:
        """Return the row as ``--json`` prints it."""
        return {
            "case": self.case,
            "published": dict(self.published),
            "ours": dict(self.ours),
            "ok": self.ok,
        }


@dataclass(frozen=True)
class Bench:
    """Where an entry works.

    out : the entry's own folder, for plots and tables.
    workers : processes at a time.
    announce : told how many runs there are in all and how many are done.
    """

    out: Path
    workers: int
    announce: Callable[[int, int], None] = field(default=lambda total, done: None)

    def run(
        self, runs: Sequence[RunSpec], work: Callable[[RunSpec], dict[str, Any]] = drive
    ) -> list[dict[str, Any]]:
        """Work on runs and return what comes of them in order, announcing each."""
        done = 0
        self.announce(len(runs), 0)

        def count(_index: int, _summary: dict[str, Any]) -> None:
            nonlocal done
            done += 1
            self.announce(len(runs), done)

        return run_all(runs, self.workers, count, work)


def at_most(case: str, published: Mapping[str, float], ours: Mapping[str, float]) -> Row:
    """Return a row that is ok if no magnitude of ours exceeds the published one's."""
    ok = all(abs(ours[key]) <= abs(bound) for key, bound in published.items())
    return Row(case, published, ours, ok)


def at_least(case: str, published: Mapping[str, float], ours: Mapping[str, float]) -> Row:
    """Return a row that is ok if every magnitude of ours reaches the published one's."""
    ok = all(abs(ours[key]) >= abs(bound) for key, bound in published.items())
    return Row(case, published, ours, ok)
