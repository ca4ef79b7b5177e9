"""Many runs on the local cores. The result does not depend on the number of workers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from typing import Any

from visctrl.robots.errors import VisctrlError
from visctrl.studies.run_spec import RunSpec
from visctrl.studies.workers import Died, LocalWorkers


class WorkerDiedError(VisctrlError):
    """The process of a run died, and died again when it was repeated."""

    exit_code = 3


def drive(run: RunSpec) -> dict[str, Any]:
    """Run one and return its summary (see `visctrl.runtime.summary.summarise`).

    Raises
    ------
    InputError
        The scenario or a setting cannot be used.
    """
    from visctrl.runtime.session import run_session

    return run_session(run.plan(), run.directory()).summary


def run_all(
    runs: Sequence[RunSpec],
    workers: int,
    on_done: Callable[[int, dict[str, Any]], None],
    work: Callable[[RunSpec], dict[str, Any]],
) -> list[dict[str, Any]]:
    """Work on runs in fresh processes and return what comes of them, in order.

    Parameters
    ----------
    runs : sequence of RunSpec
    workers : int
        Processes at a time.
    on_done : callable
        Called in this process as (index, summary) whenever a run has ended.
    work : callable
        What a process does with a run: a function of some module.

    Raises
    ------
    WorkerDiedError
        The process of a run died twice; the message names the run.
    """
    results: dict[int, dict[str, Any]] = {}
    with closing(
        LocalWorkers(workers).each(partial(_run_numbered, work), list(enumerate(runs)))
    ) as done:
        for (index, run), summary in done:
            if isinstance(summary, Died):
                named = " ".join((str(run.scenario), *run.settings))
                raise WorkerDiedError(f"run {index} ({named}): {summary.reason}")
            results[index] = summary
            on_done(index, summary)
    return [results[index] for index in range(len(runs))]


def _run_numbered(
    work: Callable[[RunSpec], dict[str, Any]], numbered: tuple[int, RunSpec]
) -> dict[str, Any]:
    return work(numbered[1])
