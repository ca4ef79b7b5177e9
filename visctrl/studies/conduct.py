"""A study from its checks to its files."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from visctrl.robots.files import write_text, writing
from visctrl.runtime.interrupts import Interrupted, Interrupts
from visctrl.studies.loading import LoadedStudy
from visctrl.studies.log import StudyLog
from visctrl.studies.runner import run_study, table_rows
from visctrl.studies.summary import SUMMARY, summarised
from visctrl.studies.table import Row, write_table
from visctrl.studies.workers import Workers


@dataclass(frozen=True)
class Conducted:
    """What came of a study.

    summary : see `summarised`. rows : of the table. files : what was written.
    interruption : the signal that ended it early.
    """

    summary: dict[str, Any]
    rows: list[Row]
    files: list[Path]
    interruption: Interrupted | None


def conduct_study(
    loaded: LoadedStudy,
    folder: Path,
    workers: Workers,
    announce: Callable[[int, float], None] = lambda done, simulated: None,
) -> Conducted:
    """Run what is left of a checked study, and write its table and summary.

    Raises
    ------
    InputError, DiskError
        The folder cannot be used.
    """
    with StudyLog(folder) as log:
        died: dict[int, Row] = {}
        interruption = None
        with Interrupts(suspendable=True) as interrupts:
            try:
                died = run_study(loaded, log, workers, interrupts, announce)
            except Interrupted as raised:
                interruption = raised
            interrupts.ignore()
            rows = table_rows(loaded, log, died)
        summary = summarised(loaded.study, loaded.origin, rows)
        with writing(folder):
            files = write_table(rows, folder)
            write_text(folder / SUMMARY, json.dumps(summary, indent=2) + "\n")
    return Conducted(summary, rows, [*files, folder / SUMMARY], interruption)
