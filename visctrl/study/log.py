"""What is finished of a study, on disk: one line a run, readable whenever the process is killed."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from io import BufferedRandom
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from visctrl.robots.errors import InputError
from visctrl.runtime.summary import versions
from visctrl.study.table import Row
from visctrl.study.trials import Trial

LOG = "runs.jsonl"


class StudyLog:
    """The finished runs of a study, in a folder that no other study may use.

    A run is known again by its key, not by its place: a study that has grown goes on with the
    runs it has. As a context manager it holds the folder.

    Parameters
    ----------
    folder : Path
        Created if it does not exist.

    Raises
    ------
    InputError
        On entering: the folder cannot be used, is in use, or was filled by another version.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.path = folder / LOG
        #: What is finished, by the run's key.
        self.rows: dict[str, Row] = {}
        self._file: BufferedRandom | None = None

    def __enter__(self) -> Self:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("a+b")
        except OSError as error:
            raise self._refusal(f"cannot be used: {error.strerror}") from None
        try:
            if not _lock(self._file):
                raise self._refusal("another study is running in it")
            self._read(self._file)
        except BaseException:
            self._file.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._file is not None:
            self._file.close()

    def check(self, trials: Iterable[Trial]) -> None:
        """Refuse a folder whose runs all belong to another study.

        Raises
        ------
        InputError
            None of its runs is one of ``trials``.
        """
        if self.rows and not any(trial.key in self.rows for trial in trials):
            raise self._refusal(
                "it holds the runs of another study, or of this one before it was changed; "
                f"choose another folder, or delete {self.path}"
            )

    def add(self, trial: Trial, row: Row) -> None:
        """Keep a finished run."""
        self.rows[trial.key] = row
        self._append({"key": trial.key, "row": row})

    def _append(self, entry: dict[str, Any]) -> None:
        assert self._file is not None, "the log is used as a context manager"
        self._file.write(json.dumps(entry).encode() + b"\n")
        self._file.flush()

    def _read(self, file: BufferedRandom) -> None:
        """Take over the finished runs; a last line that was cut short is dropped."""
        file.seek(0)
        content = file.read()
        whole = content.rfind(b"\n") + 1
        file.truncate(whole)
        lines = [_entry(line) for line in content[:whole].splitlines()]
        if not lines:
            self._append({"versions": versions()})
            return
        made_by = (lines[0] or {}).get("versions")
        if made_by is None:
            raise self._refusal(f"{self.path} is not the log of a study")
        if made_by != versions():
            changed = ", ".join(
                f"{name} {made_by.get(name)} (here {version})"
                for name, version in versions().items()
                if made_by.get(name) != version
            )
            raise self._refusal(
                f"its runs were made by {changed}; choose another folder, or delete {self.path}"
            )
        self.rows = {line["key"]: line["row"] for line in lines if line and "row" in line}

    def _refusal(self, reason: str) -> InputError:
        return InputError(f"--out {self.folder}: {reason}")


def _entry(line: bytes) -> dict[str, Any] | None:
    try:
        entry = json.loads(line)
    except ValueError:
        return None
    return entry if isinstance(entry, dict) else None


def _lock(file: BufferedRandom) -> bool:
    """Lock an open file until it is closed or this process ends; return False if it is taken."""
    if sys.platform == "win32":
        return True
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
