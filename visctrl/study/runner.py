"""Running a study: what is not finished yet, here or on a cluster, each run kept as it ends."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from typing import NamedTuple

from visctrl.montecarlo.drive import BATCH, drive_together
from visctrl.montecarlo.kinds import batchable, started_at
from visctrl.robots.errors import InputError
from visctrl.runtime.config import Start, scenario_from
from visctrl.runtime.interrupts import Interrupts
from visctrl.runtime.plan import Plan, make_plan
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.session import run_session
from visctrl.runtime.summary import STOPPED
from visctrl.study.log import StudyLog
from visctrl.study.table import DIED, REFUSED, Row, ended, row_of
from visctrl.study.trials import LoadedStudy, Trial
from visctrl.study.workers import Died, Workers, WorkerStoppedError

#: A cluster's worker may have several threads; physics engines and plugins want one.
_ONE_AT_A_TIME = threading.Lock()


class Group(NamedTuple):
    """What a worker is given: runs to drive together, or a single run.

    together : they are of one kind that array operations are made for, even if it is only one:
        a run has the same result to the bit in every group.
    """

    trials: tuple[Trial, ...]
    together: bool


def run_study(
    loaded: LoadedStudy,
    log: StudyLog,
    workers: Workers,
    interrupts: Interrupts,
    announce: Callable[[int, float], None] = lambda done, simulated: None,
) -> dict[int, Row]:
    """Run what is not in the log yet, and keep each run there as it ends.

    Parameters
    ----------
    loaded : LoadedStudy
        Checked (see `LoadedStudy.check`).
    log : StudyLog
        Entered.
    workers : Workers
        Where to run.
    interrupts : Interrupts
        Shielded while a run is written down.
    announce : callable
        Told how many runs are done, and how long these took in their own time (s).

    Returns
    -------
    dict of int to Row
        Runs whose worker died, by index. They are not in the log: a further call repeats them.
    """
    log.check(loaded.trials())
    died: dict[int, Row] = {}
    known = [log.rows[trial.key] for trial in loaded.trials() if trial.key in log.rows]
    done, simulated = len(known), sum(row["time_s"] or 0.0 for row in known)
    announce(done, simulated)
    with closing(_results(_groups(loaded, log, workers.count), workers)) as results:
        for trial, row in results:
            with interrupts.shield:
                if isinstance(row, Died):
                    died[trial.index] = ended(DIED, row.reason)
                else:
                    log.add(trial, row)
                    simulated += row["time_s"] or 0.0
            done += 1
            announce(done, simulated)
    return died


def _groups(loaded: LoadedStudy, log: StudyLog, workers: int) -> Iterator[Group]:
    """Yield what is not in the log yet, in groups that keep all workers busy."""

    def pending() -> Iterator[Trial]:
        return (trial for trial in loaded.trials() if trial.key not in log.rows)

    left = Counter(trial.kind for trial in pending())
    fit: dict[str, bool] = {}
    waiting: dict[str, list[Trial]] = {}
    for trial in pending():
        kind = trial.kind
        if kind is None or not fit.setdefault(kind, batchable(plan_of(trial))):
            yield Group((trial,), together=False)
            continue
        group = waiting.setdefault(kind, [])
        group.append(trial)
        if len(group) == min(-(-left[kind] // workers), BATCH):
            yield Group(tuple(waiting.pop(kind)), together=True)
    for group in waiting.values():
        yield Group(tuple(group), together=True)


def _results(
    groups: Iterable[Group], workers: Workers
) -> Generator[tuple[Trial, Row | Died], None, None]:
    """Yield every run with its row; those of a group whose worker died are tried one by one."""
    left: list[Trial] = []
    with closing(workers.each(run_group, groups)) as results:
        for group, rows in results:
            if not isinstance(rows, Died):
                yield from zip(group.trials, rows, strict=True)
            elif len(group.trials) > 1:
                left += group.trials
            else:
                yield group.trials[0], rows
    if left:
        yield from _results([Group((trial,), together=True) for trial in left], workers)


def run_group(group: Group) -> list[Row]:
    """Run a group and return what the table keeps of each run.

    Raises
    ------
    WorkerStoppedError
        A signal ended it.
    """
    with _ONE_AT_A_TIME:
        if not group.together:
            return [_run_alone(trial) for trial in group.trials]
        endings = drive_together(_plans(group.trials))
        pairs = zip(group.trials, endings, strict=True)
        return [row_of(end.summary) if end else _run_alone(trial) for trial, end in pairs]


def plan_of(trial: Trial) -> Plan:
    """Return the plan of a run.

    Raises
    ------
    InputError
        It cannot be run.
    """
    name = f"run {trial.index} of the study"
    return make_plan(scenario_from(trial.scenario, name, (), REGISTRIES.backends.known()))


def _plans(trials: tuple[Trial, ...]) -> list[Plan]:
    """Return the plans of runs that differ in start and seed only."""
    first = plan_of(trials[0])
    starts = (Start.model_validate(trial.scenario.get("start", {})) for trial in trials)
    seeds = (trial.scenario["seed"] for trial in trials)
    return [started_at(first, *each) for each in zip(starts, seeds, strict=True)]


def _run_alone(trial: Trial) -> Row:
    try:
        summary = run_session(plan_of(trial)).summary
    except InputError as error:
        return ended(REFUSED, str(error))
    if summary["status"] == STOPPED:
        raise WorkerStoppedError(summary["reason"])
    return row_of(summary)


def table_rows(loaded: LoadedStudy, log: StudyLog, died: dict[int, Row]) -> list[Row]:
    """Return one row for every run that has ended, in the study's order."""
    rows = []
    for trial in loaded.trials():
        row = died.get(trial.index, log.rows.get(trial.key))
        if row is not None:
            rows.append({"run": trial.index, "cell": trial.cell, **trial.values, **row})
    return rows
