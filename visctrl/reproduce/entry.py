"""What a table or figure is made of: an entry runs its cases and compares each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from visctrl.reproduce.recorded_run import drive
from visctrl.studies.batch import run_all
from visctrl.studies.run_spec import RunSpec

Numbers = Mapping[str, float]


@dataclass(frozen=True)
class Row:
    """One case: what the source reports, what its law gives here, what ours gives, the verdict.

    A key says its unit and means the same in every mapping.

    published : the source's numbers.
    source : those of the source's law (or filter), run here.
    bound : what ours is judged by where the source has no number: the project's own.
    told : settings that a user would have to make and the source does not state.
    ok : None where nothing is judged.
    """

    case: str
    ours: Numbers
    published: Numbers = field(default_factory=dict)
    source: Numbers = field(default_factory=dict)
    bound: Numbers = field(default_factory=dict)
    told: tuple[str, ...] = ()
    ok: bool | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the row as ``--json`` prints it."""
        return {
            "case": self.case,
            "published": dict(self.published),
            "source": dict(self.source),
            "ours": dict(self.ours),
            "bound": dict(self.bound),
            "told": list(self.told),
            "ok": self.ok,
        }


@dataclass(frozen=True)
class Bench:
    """Where an entry works.

    out : the entry's own folder, for plots and tables.
    workers : processes at a time.
    announce : told how many runs there are in all and how many are done.
    repeats : runs of every cell, for the entries that have cells; None for as many as they want.
    """

    out: Path
    workers: int
    announce: Callable[[int, int], None] = field(default=lambda total, done: None)
    repeats: int | None = None

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


#: Sections of a scenario that say what the robot believes and does; all others are the task.
_BELIEFS = ("perception", "estimator", "controller", "approach", "safety", "target", "obstacles")


def told(run: RunSpec, stated: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the settings of a run that are neither its task nor stated by the source.

    Parameters
    ----------
    run : RunSpec
    stated : sequence of str
        Keys that the source states, as ``controller.tau_s``.
    """
    return tuple(
        text
        for text in run.settings
        if text.partition(".")[0].partition("=")[0] in _BELIEFS
        and text.partition("=")[0] not in stated
    )


def against_source(
    case: str,
    published: Numbers,
    ours: Numbers,
    *,
    resolution: Numbers | None = None,
    source: Numbers | None = None,
    told: tuple[str, ...] = (),
) -> Row:
    """Return a row that is ok if no magnitude of ours exceeds the published one's.

    Parameters
    ----------
    resolution : mapping or None
        Half the last digit that the source prints: its 0.01 may be anything up to 0.015.
    """
    finest = resolution or {}
    ok = all(abs(ours[k]) <= abs(v) + finest.get(k, 0.0) for k, v in published.items())
    return Row(case, ours, published, source or {}, told=told, ok=ok)


def within(
    case: str,
    bound: Numbers,
    ours: Numbers,
    *,
    published: Numbers | None = None,
    source: Numbers | None = None,
    told: tuple[str, ...] = (),
) -> Row:
    """Return a row that is ok if no magnitude of ours exceeds the project's own bound."""
    ok = all(abs(ours[key]) <= abs(value) for key, value in bound.items())
    return Row(case, ours, published or {}, source or {}, bound, told, ok)


def at_least(case: str, bound: Numbers, ours: Numbers) -> Row:
    """Return a row that is ok if every magnitude of ours reaches the project's own bound."""
    ok = all(abs(ours[key]) >= abs(value) for key, value in bound.items())
    return Row(case, ours, bound=bound, ok=ok)
