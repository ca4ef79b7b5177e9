"""The emulated camera's line: pictures as MJPEG over HTTP on loopback."""

from __future__ import annotations

import logging
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any, Self

from visctrl.hal.errors import CameraError

_BOUNDARY = "frame"
_PATH = "/stream.mjpg"
_POLL_S = 0.2

_log = logging.getLogger(__name__)


class MjpegServer:
    """Sends every published picture to every client, as a context manager.

    Parameters
    ----------
    port : int
        TCP port on loopback; 0 takes a free one.
    """

    def __init__(self, port: int = 0) -> None:
        try:
            self._http = _Http(("127.0.0.1", port), _Handler)
        except OSError as error:
            raise CameraError(f"TCP port {port}: {error.strerror}; choose another") from error
        self._http.stream = self
        self.url = f"http://127.0.0.1:{self._http.server_address[1]}{_PATH}"
        self._thread = threading.Thread(
            target=self._http.serve_forever, args=(0.05,), name="mjpeg", daemon=True
        )
        self._news = threading.Condition()
        self._picture: tuple[int, bytes] = (0, b"")
        self._up = True
        self._closing = False

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Hang up on all clients and release the port."""
        with self._news:
            self._closing = True
            self._news.notify_all()
        self._http.shutdown()
        self._thread.join()
        self._http.server_close()

    def publish(self, jpeg: bytes) -> None:
        """Send a picture."""
        with self._news:
            self._picture = (self._picture[0] + 1, jpeg)
            self._news.notify_all()

    def drop(self) -> None:
        """Hang up on all clients, and take no new ones until `restore`."""
        with self._news:
            self._up = False
            self._news.notify_all()

    def restore(self) -> None:
        """Take clients again."""
        self._up = True

    @property
    def serving(self) -> bool:
        """Whether clients are served."""
        return self._up and not self._closing

    def after(self, number: int) -> tuple[int, bytes] | None:
        """Return the newest picture and its number once it exceeds ``number``; None: hang up."""
        with self._news:
            while self.serving and self._picture[0] <= number:
                self._news.wait(_POLL_S)
            return self._picture if self.serving else None


class _Http(ThreadingHTTPServer):
    daemon_threads = True
    stream: MjpegServer


class _Handler(BaseHTTPRequestHandler):
    server: _Http

    def do_GET(self) -> None:
        """Stream pictures until either side hangs up."""
        stream = self.server.stream
        if self.path != _PATH or not stream.serving:
            self.send_error(404 if self.path != _PATH else 503)
            return
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        number = 0
        try:
            while (news := stream.after(number)) is not None:
                number, jpeg = news
                head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}"
                self.wfile.write(head.encode() + b"\r\n\r\n" + jpeg + b"\r\n")
        except OSError as error:
            _log.debug("a client has gone: %s", error)

    def log_message(self, format: str, *args: Any) -> None:
        """Log requests where the rest is logged."""
        _log.debug(format, *args)
