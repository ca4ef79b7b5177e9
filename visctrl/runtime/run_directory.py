"""The run directory: new or visibly ours, locked while it is used, never emptied."""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import re
from collections.abc import Mapping
from io import BufferedRandom
from pathlib import Path
from typing import Any

from visctrl.robots.errors import InputError, VisctrlError
from visctrl.robots.files import absolute, lock, owner_only, unwritable, write_text
from visctrl.runtime.recorder import FILES, IMAGES, SUMMARY

_log = logging.getLogger(__name__)

#: What says that a directory is a run's. While the run goes on it holds room for the last files.
MARKER = ".visctrl-run"
#: Where the files of an earlier run wait until the new one has ended.
_PREVIOUS = ".visctrl-previous"
_RESERVE = b"\0" * 65_536
_MARK = b"The directory of a visctrl run.\n"
_OF_IMAGES = re.compile(r"(target-\d+|\d+)\.png|index\.csv|camera\.yaml")
_MOST_OF_ONE_NAME = 1000


class RunDirectory:
    """A directory for the files of one run.

    Parameters
    ----------
    path : Path
        Not there yet, empty, or the directory of an earlier run.
    overwrite : bool
        The files of an earlier run may be replaced; they are kept until this one has ended.
    shared : bool
        Other users of the machine may read the files.

    Raises
    ------
    InputError
        It holds other files, or a run already, or another run is writing there, or it cannot be
        created.
    DiskError
        There is no room for the files of a run.
    """

    def __init__(self, path: Path, *, overwrite: bool = False, shared: bool = False) -> None:
        #: Where it is, whatever becomes of the current directory.
        self.path = absolute(path)
        self.shared = shared
        self._named = path
        self._made: list[Path] = []
        self._marker: BufferedRandom | None = None
        self._new_marker = False
        with owner_only(unless=shared):
            try:
                self._make()
                self._claim(overwrite)
            except BaseException as error:
                self._leave()
                if isinstance(error, OSError | ValueError) and not isinstance(error, VisctrlError):
                    raise unwritable(f"--out {path}", error) from None
                raise

    @classmethod
    def numbered(cls, parent: Path, stem: str, *, shared: bool = False) -> RunDirectory:
        """Return a new directory below ``parent``, with a number where the name is taken.

        Raises
        ------
        InputError, DiskError
            It cannot be created.
        """
        for number in range(1, _MOST_OF_ONE_NAME):
            path = parent / (stem if number == 1 else f"{stem}-{number}")
            if os.path.lexists(path):
                continue
            # Another run may have taken the name since.
            with contextlib.suppress(RunDirectoryTakenError):
                return cls(path, shared=shared)
        raise InputError(f"{parent / stem}: there are too many runs of this name")

    def write_text(self, name: str, text: str) -> None:
        """Write a small file."""
        write_text(self.path / name, text)

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write ``summary.json``."""
        self.write_text(SUMMARY, json.dumps(summary, indent=2, allow_nan=False) + "\n")

    def release_reserve(self) -> None:
        """Give back the room that was kept for the files that are written last."""
        if self._marker is not None:
            with contextlib.suppress(OSError):
                self._marker.truncate(len(_MARK))

    def close(self) -> None:
        """Let others use it; the files of an earlier run are gone now."""
        self.release_reserve()
        self._drop_previous()
        self._unlock()

    def discard(self) -> None:
        """Leave everything as it was found: the run has not begun."""
        for path in self._files():
            path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            (self.path / IMAGES).rmdir()
        self._leave()

    # --- making it ours ------------------------------------------------------------------------

    def _make(self) -> None:
        """Create the directory and those above it that are missing."""
        missing = [self.path, *self.path.parents]
        while missing and os.path.isdir(missing[-1]):
            missing.pop()
        for folder in reversed(missing):
            with contextlib.suppress(FileExistsError):
                folder.mkdir()
                self._made.append(folder)
        if not os.path.isdir(self.path):
            raise NotADirectoryError(errno.ENOTDIR, "there is a file of this name")

    def _claim(self, overwrite: bool) -> None:
        """Lock the directory; refuse one that is not ours to write to."""
        marker = self.path / MARKER
        found = set(os.listdir(self.path))
        if found and MARKER not in found:
            raise InputError(
                f"--out {self._named}: holds files that are not a run's: choose a new directory"
            )
        file = marker.open("a+b")
        if not lock(file) or not _same(file, marker):
            file.close()
            raise RunDirectoryTakenError(f"--out {self._named}: another run is writing there")
        _log.info("writing to %s", self.path)
        self._new_marker = not found
        self._marker = file
        if not self._files():
            self._restore_previous()  # those that a killed run has left there
        if self._files() and not overwrite:
            raise InputError(
                f"--out {self._named}: holds a run already: choose another directory, or replace "
                "it with --overwrite"
            )
        self._reserve(file)
        self._set_aside()

    def _reserve(self, file: BufferedRandom) -> None:
        try:
            file.truncate(0)
            file.write(_MARK + _RESERVE)
            file.flush()
        except OSError as error:
            raise unwritable(f"--out {self._named}", error) from None

    def _unlock(self) -> None:
        if self._marker is not None:
            # What is still buffered belongs to the reserve.
            with contextlib.suppress(OSError):
                self._marker.close()
            self._marker = None

    def _leave(self) -> None:
        """Undo what `_make` and `_claim` have done."""
        if self._marker is not None:
            if self._new_marker:
                (self.path / MARKER).unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                self._restore_previous()
        self.release_reserve()
        self._unlock()
        with contextlib.suppress(OSError):
            for folder in reversed(self._made):
                folder.rmdir()

    # --- the files of an earlier run ---------------------------------------------------------

    def _files(self) -> list[Path]:
        """Return the files that a run has left here; no others are ever touched."""
        images = self.path / IMAGES
        names = os.listdir(images) if images.is_dir() and not images.is_symlink() else []
        own = [self.path / name for name in FILES]
        own += [images / name for name in names if _OF_IMAGES.fullmatch(name)]
        return [path for path in own if os.path.lexists(path)]

    def _set_aside(self) -> None:
        self._drop_previous()
        for path in self._files():
            kept = self.path / _PREVIOUS / path.relative_to(self.path)
            kept.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, kept)

    def _restore_previous(self) -> None:
        for kept in self._kept():
            path = self.path / kept.relative_to(self.path / _PREVIOUS)
            path.parent.mkdir(exist_ok=True)
            os.replace(kept, path)
        self._drop_previous()

    def _drop_previous(self) -> None:
        for kept in self._kept():
            kept.unlink()
        with contextlib.suppress(OSError):
            for folder in (self.path / _PREVIOUS / IMAGES, self.path / _PREVIOUS):
                if folder.is_dir():
                    folder.rmdir()

    def _kept(self) -> list[Path]:
        folder = self.path / _PREVIOUS
        return [path for path in folder.rglob("*") if not path.is_dir()] if folder.is_dir() else []


class RunDirectoryTakenError(InputError):
    """Another run is writing there."""


def _same(file: BufferedRandom, path: Path) -> bool:
    """Return whether a path still leads to an open file: its owner may have removed it."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except OSError:
        return False
