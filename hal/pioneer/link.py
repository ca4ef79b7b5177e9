"""The line to the robot: paced commands out, packets in. Any URL that pyserial knows."""

from __future__ import annotations

import errno
import logging
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from urllib.parse import urlsplit

import serial

from visctrl.hal.errors import LinkError
from visctrl.hal.interfaces import Clock
from visctrl.hal.pioneer.commands import Command
from visctrl.hal.pioneer.guardian import Guardian
from visctrl.hal.pioneer.packet import Packet, StreamDecoder

#: Least time between two commands (s). The firmware reads one per millisecond interrupt and the
#: manual asks for 3 to 5 ms; the margin covers what the way to the robot adds or takes.
SPACING_S = 0.006
#: After such a pause (s) the firmware may have stopped by itself, with its old set-points kept.
PAUSE_S = 1.0
#: What a controller gets to change the rate of its line (s), as the vendor's library gives it.
_SWITCH_S = 0.01
#: Longest wait for bytes (s): how late other work of the reading thread can be.
READ_TIMEOUT_S = 0.02
# pyserial also counts the time that this process is not scheduled.
_WRITE_TIMEOUT_S = 1.0
_PORT_ERRORS: tuple[type[Exception], ...] = (OSError, ValueError)
with suppress(ImportError):  # POSIX terminals have errors of their own, which pyserial leaks
    import termios

    _PORT_ERRORS += (termios.error,)

_HANG_UPS = (errno.EIO, errno.EPIPE, errno.ECONNRESET)
#: What the vendor's messages, whose numbers are lost, say in that case.
_HANG_UP_SIGNS = ("disconnected", "readiness to read", "Broken pipe", "reset by peer")

_log = logging.getLogger(__name__)


class Link:
    """A serial line, serial device server or pseudo-terminal with a robot at its end.

    One thread may receive while others send.

    Parameters
    ----------
    url : str
        Device (``/dev/ttyUSB0``, ``COM3``) or URL (``socket://host:8101``).
    clock : Clock
        Of the stamps and the pacing.
    """

    def __init__(self, url: str, clock: Clock) -> None:
        self.url = url
        self._clock = clock
        self._port: serial.Serial | None = None
        self._decoder = StreamDecoder()
        self._guardian: Guardian | None = None
        self._sending = threading.Lock()
        #: Set to let whoever waits in `receive_for` give up.
        self.abandoned = threading.Event()
        #: Rate of a real line; None for what has none.
        self.baud: int | None = None
        #: When the last command went out (s).
        self.last_sent = float("-inf")
        #: What the robot must hear first after a pause of more than `PAUSE_S`.
        self.after_pause: tuple[Command, ...] = ()

    def open(self) -> None:
        """Open the port, for this process only.

        Raises
        ------
        LinkError
            There is no such port, it is busy, or not allowed; the message says what to do.
        """
        if self.url.startswith("socket://") and not _has_port(self.url):
            raise LinkError(f"port {self.url}: expected socket://HOST:PORT")
        try:
            self._port = serial.serial_for_url(
                self.url,
                timeout=READ_TIMEOUT_S,
                write_timeout=_WRITE_TIMEOUT_S,
                exclusive=True,
            )
        except _PORT_ERRORS as error:
            raise LinkError(f"port {self.url}: {_why(error)}") from error
        _send_at_once(self._port)

    def guard(self, stop: Sequence[Command], timeout: float) -> None:
        """Have a process of its own send ``stop`` when this one cannot (see `Guardian`).

        It needs a line that processes can share, a terminal or a socket; that there is none is
        logged.
        """
        if self._guardian is not None:
            return
        try:
            with self._guarded() as port:
                line = port.fileno()
        except (LinkError, AttributeError):
            _log.warning(
                "%s cannot be shared with a second process: if this one is killed or held up, "
                "only the robot's own watchdog stops it",
                self.url,
            )
            return
        try:
            self._guardian = Guardian(line, [each.encode() for each in stop], timeout)
        except OSError as error:
            _log.warning(
                "no second process guards the robot (%s): if this one is killed or held up, only "
                "the robot's own watchdog stops it",
                error,
            )

    def beat(self, *, moving: bool) -> None:
        """Tell the guardian that the robot is commanded (see `Guardian.beat`).

        Raises
        ------
        LinkError
            The robot is to move, and its guardian has ended.
        """
        if self._guardian is not None and not self._guardian.beat(moving=moving) and moving:
            raise LinkError(self._unguarded)

    @property
    def _unguarded(self) -> str:
        return f"port {self.url}: the process that guards the robot has ended"

    def close(self) -> None:
        """Close the port. Safe to call twice."""
        if self._guardian is not None:
            guardian, self._guardian = self._guardian, None
            guardian.close()
        if self._port is not None:
            port, self._port = self._port, None
            try:
                port.close()
            except _PORT_ERRORS as error:
                _log.debug("closing %s: %s", self.url, error)

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._port is not None

    @property
    def has_baud(self) -> bool:
        """Whether the port is a real line, whose rate must be found."""
        return "://" not in self.url

    def set_baud(self, baud: int) -> None:
        """Change the line's rate and forget what has arrived so far."""
        with self._guarded() as port:
            if self.has_baud:
                port.baudrate = self.baud = baud
            port.reset_input_buffer()
        self._decoder = StreamDecoder()

    def switch_baud(self, baud: int, request: Command) -> None:
        """Ask the robot for another rate of the line, and take it."""
        self.send(request)
        # Its last byte must be on the line, and the controller gets a moment to change.
        with self._guarded() as port:
            port.flush()
        self._clock.sleep_until(self._clock.now() + _SWITCH_S)
        self.set_baud(baud)

    def send(self, *commands: Command) -> bool:
        """Send commands, no closer together than the firmware can take them.

        After a pause, `after_pause` goes first, and all of ``commands`` behind it, even if the
        process was held up in the middle of them. Return whether that was so.

        Raises
        ------
        LinkError
            The port is gone or does not take bytes.
        """
        paused = False
        with self._sending:
            sent = 0
            while sent < len(commands):
                self._clock.sleep_until(self.last_sent + SPACING_S)
                if self.after_pause and self._clock.now() - self.last_sent > PAUSE_S:
                    paused, sent = True, 0
                    for command in self.after_pause:
                        self._write(command)
                else:
                    self._write(commands[sent])
                    sent += 1
        return paused

    def _write(self, command: Command) -> None:
        data = command.encode()
        self._clock.sleep_until(self.last_sent + SPACING_S)
        with self._guarded() as port:
            port.write(data)
        self.last_sent = self._clock.now()

    def receive(self) -> list[Packet]:
        """Return the packets that have arrived; wait shortly if there is nothing.

        Raises
        ------
        LinkError
            The port is gone, or the process that guards the robot.
        """
        if self._guardian is not None and self._guardian.lost:
            raise LinkError(self._unguarded)
        with self._guarded() as port:
            data = port.read(self._decoder.wanted)
        return self._decoder.feed(data, self._clock.now())

    def receive_for(self, seconds: float) -> Iterator[Packet]:
        """Yield packets as they arrive during the next ``seconds``.

        Raises
        ------
        LinkError
            The port is gone, or the link has been abandoned.
        """
        deadline = self._clock.now() + seconds
        while self._clock.now() < deadline:
            if self.abandoned.is_set():
                raise LinkError(f"port {self.url}: given up")
            yield from self.receive()

    @property
    def noise(self) -> int:
        """Bytes since the last change of rate that belong to no packet."""
        return self._decoder.discarded + self._decoder.pending

    @contextmanager
    def _guarded(self) -> Iterator[serial.Serial]:
        port = self._port
        if port is None:
            raise LinkError(f"port {self.url} is closed")
        try:
            yield port
        except _PORT_ERRORS as error:
            raise LinkError(f"port {self.url} failed: {_why(error)}") from error


def _has_port(url: str) -> bool:
    try:
        return urlsplit(url).port is not None
    except ValueError:
        return False


def _send_at_once(port: serial.Serial) -> None:
    """Keep TCP from collecting commands into bursts, which would undo their spacing."""
    connection = getattr(port, "_socket", None)
    if isinstance(connection, socket.socket):
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def _why(error: Exception) -> str:
    """Return what an error of the port means, and what to do about it."""
    text = str(error)
    number = getattr(error, "errno", None)
    if number == errno.ENOENT or ("could not open port" in text and "No such file" in text):
        return "there is no such port; `visctrl doctor` lists those there are"
    if number == errno.EACCES or "Permission denied" in text:
        return "permission denied; join the group that owns it (often 'dialout') and log in again"
    if "exclusively lock" in text or number == errno.EBUSY:
        return "it is in use by another process"
    if number == errno.EISDIR or "configure port" in text:
        return "it is no serial port"
    if number in _HANG_UPS or any(sign in text for sign in _HANG_UP_SIGNS):
        return "the other end has hung up"
    return text or type(error).__name__
