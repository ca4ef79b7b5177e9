"""Running a study: what is not finished yet, here or on a cluster, each run kept as it ends."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing

from visctrl.robots.errors import InputError
from visctrl.runtime.interrupts import Interrupts
from visctrl.runtime.session import run_session
from visctrl.runtime.summary import STOPPED
from visctrl.studies.loading import LoadedStudy
from visctrl.studies.log import StudyLog
from visctrl.studies.run_spec import RunSpec
from visctrl.studies.table import DIED, REFUSED, Row, ended, row_of
from visctrl.studies.workers import Died, Workers, WorkerStoppedError

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
    log.check(loaded.runs())
    died: dict[int, Row] = {}
    known = [log.rows[run.key] for run in loaded.runs() if run.key in log.rows]
    done, simulated = len(known), sum(row["time_s"] or 0.0 for row in known)
    announce(done, simulated)
    pending = (run for run in loaded.runs() if run.key not in log.rows)
    with closing(workers.each(run_once, pending)) as results:
        for run, row in results:
            with interrupts.shield:
                if isinstance(row, Died):
                    died[run.index] = ended(DIED, row.reason)
                else:
                    log.add(run, row)
                    simulated += row["time_s"] or 0.0
            done += 1
            announce(done, simulated)
    return died


def run_once(run: RunSpec) -> Row:
    """Run a study's run and return what the table keeps of it.

    Raises
    ------
    WorkerStoppedError
        A signal ended it.
    """
    with _ONE_AT_A_TIME:
        try:
            summary = run_session(run.plan()).summary
        except InputError as error:
            return ended(REFUSED, str(error))
    if summary["status"] == STOPPED:
        raise WorkerStoppedError(summary["reason"])
    return row_of(summary)


def table_rows(loaded: LoadedStudy, log: StudyLog, died: dict[int, Row]) -> list[Row]:
    """Return one row for every run that has ended, in the study's order."""
    rows = []
    for run in loaded.runs():
        row = died.get(run.index, log.rows.get(run.key))
        if row is not None:
            rows.append({"run": run.index, "cell": run.cell, **run.values, **row})
    return rows
