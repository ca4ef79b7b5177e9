"""What is finished of a study, on disk: one line a run, readable whenever the process is killed."""

from __future__ import annotations

import json
from collections.abc import Iterable
from io import BufferedRandom
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from visctrl.robots.errors import InputError
from visctrl.robots.files import absolute, lock, unwritable
from visctrl.runtime.summary import versions
from visctrl.studies.run_spec import RunSpec
from visctrl.studies.summary import SUMMARY
from visctrl.studies.table import PARQUET, TABLE, Row, is_row

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
        self.folder = absolute(folder)
        self.path = self.folder / LOG
        self._named = folder
        #: What is finished, by the run's key.
        self.rows: dict[str, Row] = {}
        self._file: BufferedRandom | None = None

    def __enter__(self) -> Self:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._refuse_strangers()
            self._file = self.path.open("a+b")
        except OSError as error:
            raise unwritable(f"--out {self._named}", error) from None
        try:
            if not lock(self._file):
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

    def check(self, runs: Iterable[RunSpec]) -> None:
        """Refuse a folder whose runs all belong to another study.

        Raises
        ------
        InputError
            None of its runs is one of ``runs``.
        """
        if self.rows and not any(run.key in self.rows for run in runs):
            raise self._refusal(
                "it holds the runs of another study, or of this one before it was changed; "
                f"choose another folder, or delete {self.path}"
            )

    def add(self, run: RunSpec, row: Row) -> None:
        """Keep a finished run."""
        self.rows[run.key] = row
        self._append({"key": run.key, "row": row})

    def _refuse_strangers(self) -> None:
        """Refuse a folder whose files would be taken for a study's and replaced."""
        if self.path.exists():
            if not self.path.is_file():
                raise self._refusal(f"{self.path} is not a file")
            return
        for name in (TABLE, PARQUET, SUMMARY):
            if (self.folder / name).exists():
                raise self._refusal(f"holds a {name} that is not a study's: choose another folder")

    def _append(self, entry: dict[str, Any]) -> None:
        assert self._file is not None, "the log is used as a context manager"
        try:
            self._file.write(json.dumps(entry).encode() + b"\n")
            self._file.flush()
        except OSError as error:
            raise unwritable(self.path, error) from None

    def _read(self, file: BufferedRandom) -> None:
        """Take over the finished runs; a last line that was cut short is dropped."""
        file.seek(0)
        content = file.read()
        whole = content.rfind(b"\n") + 1
        lines = [_entry(line) for line in content[:whole].splitlines()]
        if not content:
            self._append({"versions": versions()})
            return
        made_by = lines[0].get("versions") if lines and lines[0] else None
        if not isinstance(made_by, dict):
            raise self._refusal(f"{self.path} is not the log of a study")
        file.truncate(whole)
        if made_by != versions():
            changed = ", ".join(
                f"{name} {made_by.get(name)} (here {version})"
                for name, version in versions().items()
                if made_by.get(name) != version
            )
            raise self._refusal(
                f"its runs were made by {changed}; choose another folder, or delete {self.path}"
            )
        self.rows = {line["key"]: line["row"] for line in lines if line and _is_row(line)}

    def _refusal(self, reason: str) -> InputError:
        return InputError(f"--out {self._named}: {reason}")


def _is_row(entry: dict[str, Any]) -> bool:
    """Return whether a line of the log holds a finished run: any other one is run again."""
    return isinstance(entry.get("key"), str) and is_row(entry.get("row"))


def _entry(line: bytes) -> dict[str, Any] | None:
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return entry if isinstance(entry, dict) else None
