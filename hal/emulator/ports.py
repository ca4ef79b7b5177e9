"""Where clients of the emulator connect: a pseudo-terminal, or a TCP port on loopback."""

from __future__ import annotations

import contextlib
import os
import select
import socket
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from visctrl.hal.errors import LinkError
from visctrl.hal.pioneer.commands import HOST_BAUD_CODES

_CHUNK = 4096
_OUTPUT_RATE = 5  # place in a terminal's settings


class Port(ABC):
    """The robot's end of a line. Never blocks; bytes that find no taker are lost."""

    #: What a client passes to its driver.
    url: str

    @abstractmethod
    def wait(self, seconds: float) -> None:
        """Return when there may be something to read, at the latest after ``seconds``."""

    @abstractmethod
    def read(self) -> bytes:
        """Return what has arrived."""

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Send bytes."""

    @abstractmethod
    def close(self) -> None:
        """Release the port."""

    def set_rate(self, baud: int) -> None:
        """Change the rate of the robot's end; a port that has none does nothing."""
        del baud

    def lost_client(self) -> bool:
        """Return, once, that the client has hung up; a serial line cannot tell."""
        return False


class PtyPort(Port):
    """A pseudo-terminal, which behaves like a serial line.

    Parameters
    ----------
    baud : int or None
        Rate of the robot's end; at any other rate only noise passes. None: all rates will do.
    """

    def __init__(self, baud: int | None = None) -> None:
        try:
            import termios
            import tty
        except ImportError:
            raise LinkError("pseudo-terminals need a POSIX system; use a socket") from None
        self._rates = {
            rate: getattr(termios, f"B{rate}") for rate in (baud or 9600, *HOST_BAUD_CODES)
        }
        self._rate = None if baud is None else self._rates[baud]
        self._settings: Callable[[int], list[Any]] = termios.tcgetattr
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        # Its own slave stays open, so that the terminal survives clients that come and go.
        self.url = os.ttyname(self._slave)

    def wait(self, seconds: float) -> None:
        """Wait for bytes."""
        select.select([self._master], [], [], seconds)

    def read(self) -> bytes:
        """Return what has arrived."""
        with contextlib.suppress(BlockingIOError):
            return self._through_line(os.read(self._master, _CHUNK))
        return b""

    def write(self, data: bytes) -> None:
        """Send bytes; what exceeds the terminal's buffer is lost, as on a line."""
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, self._through_line(data))

    def set_rate(self, baud: int) -> None:
        """Change the rate of the robot's end, if it has one."""
        if self._rate is not None:
            self._rate = self._rates[baud]

    def close(self) -> None:
        """Close both ends."""
        os.close(self._master)
        os.close(self._slave)

    def _through_line(self, data: bytes) -> bytes:
        """Return what bytes become on the way: noise, where the rates differ."""
        if self._rate is None or self._settings(self._slave)[_OUTPUT_RATE] == self._rate:
            return data
        return bytes((byte * 37 + 11) & 0xFF for byte in data)


class TcpPort(Port):
    """A port on loopback that serves one client at a time, as serial device servers do."""

    def __init__(self, port: int = 0) -> None:
        self._listener = socket.socket()
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listener.bind(("127.0.0.1", port))
        except OSError as error:
            self._listener.close()
            raise LinkError(f"TCP port {port}: {error.strerror}; choose another") from error
        self._listener.listen()
        self._listener.setblocking(False)
        self._client: socket.socket | None = None
        self._lost = False
        self.url = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"

    def wait(self, seconds: float) -> None:
        """Wait for bytes or a client."""
        sockets = [self._listener] if self._client is None else [self._listener, self._client]
        select.select(sockets, [], [], seconds)
        with contextlib.suppress(BlockingIOError):
            self._admit(self._listener.accept()[0])

    def read(self) -> bytes:
        """Return what has arrived."""
        if self._client is None:
            return b""
        try:
            data = self._client.recv(_CHUNK)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._drop()
        return data

    def write(self, data: bytes) -> None:
        """Send bytes."""
        if self._client is None:
            return
        try:
            self._client.send(data)
        except BlockingIOError:
            return
        except OSError:
            self._drop()

    def lost_client(self) -> bool:
        """Return, once, that the client has hung up."""
        lost, self._lost = self._lost, False
        return lost

    def close(self) -> None:
        """Hang up."""
        self._drop()
        self._listener.close()

    def _admit(self, client: socket.socket) -> None:
        if self._client is not None:
            client.close()  # busy
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client = client

    def _drop(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client, self._lost = None, True
