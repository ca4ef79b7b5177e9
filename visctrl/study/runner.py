"""Running a study: what is not finished yet, here or on a cluster, each run kept as it ends."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing

from visctrl.robots.errors import InputError
from visctrl.runtime.config import scenario_from
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
    pending = (trial for trial in loaded.trials() if trial.key not in log.rows)
    with closing(workers.each(run_trial, pending)) as results:
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


def run_trial(trial: Trial) -> Row:
    """Run a trial and return what the table keeps of it.

    Raises
    ------
    WorkerStoppedError
        A signal ended it.
    """
    with _ONE_AT_A_TIME:
        try:
            summary = run_session(plan_of(trial)).summary
        except InputError as error:
            return ended(REFUSED, str(error))
    if summary["status"] == STOPPED:
        raise WorkerStoppedError(summary["reason"])
    return row_of(summary)


def plan_of(trial: Trial) -> Plan:
    """Return the plan of a run.

    Raises
    ------
    InputError
        It cannot be run.
    """
    name = f"run {trial.index} of the study"
    return make_plan(scenario_from(trial.scenario, name, (), REGISTRIES.backends.known()))


def table_rows(loaded: LoadedStudy, log: StudyLog, died: dict[int, Row]) -> list[Row]:
    """Return one row for every run that has ended, in the study's order."""
    rows = []
    for trial in loaded.trials():
        row = died.get(trial.index, log.rows.get(trial.key))
        if row is not None:
            rows.append({"run": trial.index, "cell": trial.cell, **trial.values, **row})
    return rows
