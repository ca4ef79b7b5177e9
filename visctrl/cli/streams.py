"""Standard streams that may be closed, full, broken or plain ASCII without ending a run."""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast


class Outlet(io.TextIOBase):
    """Hands text on to a stream, and lets it fall once the stream fails.

    Parameters
    ----------
    stream : TextIO
        What is written to.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        #: What happened, None if nothing did.
        self.failure: OSError | None = None
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")

    def write(self, text: str) -> int:
        """Write; after a failure, do nothing."""
        return cast(int, self._safely(lambda: self._stream.write(text), len(text)))

    def flush(self) -> None:
        """Flush; after a failure, do nothing."""
        self._safely(self._stream.flush, None)

    def _safely(self, work: Any, otherwise: object) -> object:
        if self.failure is not None:
            return otherwise
        try:
            return work()
        except (OSError, ValueError) as error:
            # A ValueError says that somebody has closed it.
            self.failure = error if isinstance(error, OSError) else OSError(errno.EPIPE, "closed")
            self._drain()
            return otherwise

    def _drain(self) -> None:
        """Let what is still buffered go nowhere: at its end, Python would try again."""
        with suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)

    @property
    def lost(self) -> OSError | None:
        """What kept a reader from getting the output; None if that reader chose to leave."""
        gone = self.failure is not None and self.failure.errno == errno.EPIPE
        return None if gone else self.failure

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """Of the stream."""
        return self._stream.encoding

    @property
    def errors(self) -> str | None:  # type: ignore[override]
        """Of the stream."""
        return self._stream.errors

    def fileno(self) -> int:
        """Return the stream's descriptor."""
        return self._stream.fileno()

    def isatty(self) -> bool:
        """Return whether a person reads it."""
        return self._stream.isatty()

    def writable(self) -> bool:
        """Return True."""
        return True


@contextmanager
def standard_outlets() -> Iterator[tuple[Outlet, Outlet]]:
    """Put outlets in the place of stdout and stderr; streams that are closed lead nowhere.

    What is opened later must not get the number of a closed one: what libraries print would go
    to a robot.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    kept = sys.stdout, sys.stderr
    out, err = (Outlet(stream or open(os.devnull, "w")) for stream in kept)  # noqa: SIM115
    sys.stdout, sys.stderr = cast(TextIO, out), cast(TextIO, err)
    try:
        yield out, err
    finally:
        out.flush()
        err.flush()
        sys.stdout, sys.stderr = kept
