"""Files that are whole or not there, locked while they are used, and their owner's alone."""

from __future__ import annotations

import errno
import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from visctrl.robots.errors import DiskError, InputError, VisctrlError

#: What a disk does, as opposed to a name that cannot be used.
_OF_THE_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}
#: Part of a long name that the file written beside it takes over.
_NAME = 100
#: Permissions that nobody but the owner gets.
_OTHERS = 0o077


def absolute(path: Path) -> Path:
    """Return a path that means the same after a change of the current directory.

    Raises
    ------
    InputError
        It is relative to a directory that is gone.
    """
    try:
        return Path(os.path.abspath(path))
    except FileNotFoundError:
        raise InputError(f"{path}: the current directory is gone: change to another one") from None


def utf_8(path: Path) -> bool:
    """Return whether a name is UTF-8: libraries written in C crash over others."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


def openable(name: str) -> bool:
    """Return whether a library written in C may open what a name leads to.

    A pipe would hold it, and with it the program, for ever; a name that is not UTF-8 crashes it.
    """
    if not utf_8(Path(name)):
        return False
    try:
        mode = os.stat(name).st_mode
    except (OSError, ValueError):  # a URL, a number, or nothing: it will say so
        return "\0" not in name
    return stat.S_ISREG(mode) or stat.S_ISCHR(mode)


def read_bytes(path: Path, most: int) -> bytes:
    """Return what a file holds.

    Parameters
    ----------
    path : Path
        Of a regular file: pipes and devices may never end.
    most : int
        Bytes that a file of this kind has at most.

    Raises
    ------
    InputError
        It is not there, no file, too large, or cannot be read; the message names it.
    """
    try:
        # Opening a pipe would wait for somebody to write.
        number = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
        with open(number, "rb") as file:
            about = os.fstat(number)
            if not stat.S_ISREG(about.st_mode):
                kind = "a folder" if stat.S_ISDIR(about.st_mode) else "not a file"
                raise InputError(f"{path}: is {kind}")
            data = file.read(most + 1)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{path}: cannot be read: {reason}") from None
    if len(data) > most:
        raise InputError(f"{path}: is larger than {most / 1e6:g} MB, the most that it may be")
    return data


def read_text(path: Path, most: int) -> str:
    """Return the text that a UTF-8 file holds (see `read_bytes`)."""
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: cannot be read: byte {error.start} is not UTF-8 text") from None


def unwritable(what: object, error: OSError | ValueError) -> VisctrlError:
    """Return what to tell of a file that cannot be written: the disk's fault, or the name's."""
    reason = getattr(error, "strerror", None) or str(error)
    if getattr(error, "errno", None) in _OF_THE_DISK:
        return DiskError(f"{what}: cannot be written: {reason}")
    return InputError(f"{what}: cannot be written: {reason}")


@contextmanager
def writing(what: object) -> Iterator[None]:
    """Tell failures to write in one line that names ``what``.

    Raises
    ------
    InputError, DiskError
        See `unwritable`.
    """
    try:
        yield
    except VisctrlError:
        raise
    except (OSError, ValueError) as error:
        raise unwritable(what, error) from None


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a name to write to, which takes the place of ``path`` once all is written.

    Whatever happens, there is the old file or the new one, whole.

    Raises
    ------
    OSError
        The new file cannot take its place.
    """
    fresh = path.with_name(f".{path.name[:_NAME]}.{os.getpid()}.new")
    try:
        yield fresh
        os.replace(fresh, path)
    finally:
        fresh.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a file at once or not at all (see `replacing`)."""
    write_bytes(path, text.encode("utf-8", errors="backslashreplace"))


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file at once or not at all (see `replacing`)."""
    with replacing(path) as fresh:
        fresh.write_bytes(data)


@contextmanager
def owner_only(*, unless: bool = False) -> Iterator[None]:
    """Let what is created meanwhile, by any thread, be its owner's alone: 0600 and 0700."""
    if unless:
        yield
        return
    before = os.umask(_OTHERS)
    os.umask(before | _OTHERS)
    try:
        yield
    finally:
        os.umask(before)


def lock(file: IO[Any]) -> bool:
    """Lock an open file until it is closed or this process ends; return False if it is taken."""
    if sys.platform == "win32":
        return True
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
