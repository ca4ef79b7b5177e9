"""A run in the Foxglove app: as a file to open later, or served while it goes on."""

from __future__ import annotations

import atexit
import importlib.util
import secrets
import threading
import time
from collections.abc import Callable
from pathlib import Path
from queue import Full, Queue
from typing import TYPE_CHECKING

from visctrl.robots.errors import InputError
from visctrl.runtime.records import Observer, Setup, TickRecord
from visctrl.viewers.foxglove.gate import Gate, hidden_address
from visctrl.viewers.web.address import Address

if TYPE_CHECKING:
    from foxglove import Context

DEFAULT_PORT = 8765
_PACKAGE = "foxglove"
#: Ticks that may wait to be encoded, and messages that may wait for a slow viewer.
_BACKLOG = 32
_VIEWER_BACKLOG = 64
#: How long the end of a run waits for viewers to take leave (s).
_PATIENCE_S = 1.0


def require_viewer(option: str) -> None:
    """Check that the Foxglove package is installed.

    Raises
    ------
    InputError
        It is not; the message says how to install it.
    """
    if importlib.util.find_spec(_PACKAGE) is None:
        raise InputError(f"{option} needs an extra package: pip install 'visctrl[viz]'")


class ViewerStream(Observer):
    """Encodes ticks in a thread of its own and hands them to a file or a server.

    A run never waits for it: with too many waiting, ticks are given up. Only where time stands
    still during a tick may a file be waited for.

    Parameters
    ----------
    setup : Setup
        Of the run.
    context : foxglove.Context
        Of an open file or server.
    close_sink : callable
        Closes that.
    wait : bool
        The run may wait for the encoder.
    """

    def __init__(
        self, setup: Setup, context: Context, close_sink: Callable[[], object], *, wait: bool
    ) -> None:
        from visctrl.viewers.foxglove.messages import Publisher

        # Its channels close as soon as nobody holds it.
        self._context = context
        self._close_sink = close_sink
        self._publisher = Publisher(setup, context, time.time_ns())
        self._wait = wait
        self._queue: Queue[TickRecord | None] = Queue(_BACKLOG)
        #: Ticks left out because encoding was too slow.
        self.given_up = 0
        #: The door to it, where it is served.
        self.gate: Gate | None = None
        #: What went wrong, empty if nothing.
        self.problem = ""
        self._closed = False
        self._thread = threading.Thread(target=self._publish_all, name="viewer", daemon=True)
        self._thread.start()

    @classmethod
    def to_file(cls, setup: Setup, path: Path, *, wait: bool) -> ViewerStream:
        """Write an MCAP file; one that is there is replaced.

        Raises
        ------
        InputError
            The package is missing, or the file cannot be written.
        """
        require_viewer("--mcap")
        import foxglove

        context = foxglove.Context()
        try:
            writer = foxglove.open_mcap(path, allow_overwrite=True, context=context)
        except Exception as error:
            raise InputError(f"--mcap: {path} cannot be written: {error}") from None
        return cls(setup, context, writer.close, wait=wait)

    @classmethod
    def to_viewers(cls, setup: Setup, host: str, port: int, option: str) -> ViewerStream:
        """Serve the Foxglove app, behind a gate that asks for a token (see `Gate`).

        Raises
        ------
        InputError
            The package is missing, or it is not possible to listen there.
        """
        require_viewer(option)
        import foxglove

        context = foxglove.Context()
        hidden = hidden_address()
        server = foxglove.start_server(
            name="visctrl",
            host=hidden.host,
            port=hidden.port,
            context=context,
            message_backlog_size=_VIEWER_BACKLOG,
        )
        try:
            where = Address(hidden.host, server.port)
            gate = Gate(Address(host, port), where, secrets.token_urlsafe(16))
        except OSError as error:
            server.stop()
            raise InputError(
                f"{option} {host}:{port}: cannot listen there: {error.strerror or error}; choose "
                "another HOST:PORT"
            ) from None
        stream = cls(setup, context, server.stop, wait=False)
        stream.gate = gate
        return stream

    def on_tick(self, record: TickRecord) -> None:
        """Queue a tick."""
        if self.problem:
            return
        if self._wait:
            self._queue.put(record)
            return
        try:
            self._queue.put_nowait(record)
        except Full:
            self.given_up += 1

    def close(self) -> None:
        """Encode what is left and close the file or the server; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        self._queue.put(None)
        self._thread.join()
        if self.gate is None:
            self._close_sink()
            return
        # A server ends only once every viewer has read what it was sent: some never do.
        closing = threading.Thread(target=self._close_sink, name="viewer-end", daemon=True)
        closing.start()
        closing.join(_PATIENCE_S)
        if closing.is_alive():
            # At its end the program would wait for the same viewers.
            from foxglove import _foxglove_py

            atexit.unregister(_foxglove_py.shutdown)
        self.gate.close()

    def _publish_all(self) -> None:
        while (record := self._queue.get()) is not None:
            if self.problem:
                continue
            try:
                self._publisher.publish(record)
            except Exception as error:
                self.problem = f"viewing ended early: {error}"
