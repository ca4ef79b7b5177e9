"""The page's HTTP server, in threads of its own: a browser never delays a tick."""

from __future__ import annotations

import json
import secrets
import socket
import threading
import time
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from socketserver import TCPServer
from types import TracebackType
from typing import Any, ClassVar, Self
from urllib.parse import parse_qs, urlsplit

from visctrl.robots.errors import InputError
from visctrl.runtime.stop import StopRequest
from visctrl.viewers.web.address import Access, Address
from visctrl.viewers.web.lanes import PENALTY_S, Connection, Lanes
from visctrl.viewers.web.view import LiveView

DEFAULT_PORT = 8050
OPTION = "--web-address"

#: A browser that does not take its answer for so long is let go (s).
_PATIENCE_S = 5.0
#: Between two requests on one connection (s).
_PAUSE_S = 0.02
#: How long the page stays for its watchers to see how the run ended, and who is one (s).
_FAREWELL_S, _WATCHING_S = 1.5, 1.0
_FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
}
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class WebPage:
    """Serves a page that shows a run and can stop it; used as a context.

    Parameters
    ----------
    view : LiveView
        What to show.
    stop : StopRequest
        What the STOP button presses.
    address : Address
        Where to listen. Anywhere but on loopback, a fresh token is needed to look or stop.

    Raises
    ------
    InputError
        It is not possible to listen there.
    """

    def __init__(self, view: LiveView, stop: StopRequest, address: Address) -> None:
        token = "" if address.is_loopback else secrets.token_urlsafe(16)
        try:
            self._server = _Server(address, token, view, stop)
        except OSError as error:
            raise InputError(
                f"{OPTION} {address.host}:{address.port}: cannot listen there: "
                f"{error.strerror or error}; choose another HOST:PORT"
            ) from None
        self._view = view
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="web", daemon=True
        )

    @property
    def address(self) -> Address:
        """Where it listens."""
        return self._server.access.address

    @property
    def token(self) -> str:
        """What a request must show, empty if nothing."""
        return self._server.access.token

    @property
    def url(self) -> str:
        """The page's URL; the token is in the part that browsers keep to themselves."""
        address = self.address
        anywhere = address.host in ("0.0.0.0", "::")
        url = address.url(_own_address() if anywhere else "")
        return f"{url}#{self.token}" if self.token else url

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._server.closed = True
        self._server.shutdown()
        self._server.server_close()
        self._server.lanes.dismiss_all()
        self._thread.join()

    def finish(self, status: str, reason: str) -> None:
        """Show how the run ended, and wait a moment until those who watch have seen it."""
        watching = time.monotonic() - self._server.looked_at < _WATCHING_S
        self._view.finish(status, reason)
        if watching:
            self._server.end_seen.wait(_FAREWELL_S)


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = 128

    def __init__(self, address: Address, token: str, view: LiveView, stop: StopRequest) -> None:
        self.address_family = address.family
        self.view = view
        self.stop = stop
        self.looked_at = -1e9
        self.end_seen = threading.Event()
        self.closed = False
        self.lanes = Lanes()
        self._connections: dict[socket.socket, Connection] = {}
        self.access = Access(address, token)
        super().__init__((address.host, address.port), _Handler)
        self.access = Access(Address(address.host, self.server_port), token)

    def server_bind(self) -> None:
        """Bind without looking up our own name, which may take seconds on a robot's network."""
        TCPServer.server_bind(self)
        self.server_name = self.access.address.host
        self.server_port = self.socket.getsockname()[1]

    def process_request(self, request: Any, client_address: Any) -> None:
        self._connections[request] = self.lanes.admit(request, client_address[0])
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.lanes.leave(self._connections.pop(request))

    def connection_of(self, request: socket.socket) -> Connection:
        """Return what is known of a connection."""
        return self._connections[request]

    def service_actions(self) -> None:
        """Look, a few times a second, for requests that never become whole."""
        self.lanes.dismiss_late()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Forget a browser that went away: there is nobody to tell."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    protocol_version = "HTTP/1.1"
    server_version = "visctrl"
    sys_version = ""
    timeout: ClassVar[float] = _PATIENCE_S

    def setup(self) -> None:
        super().setup()
        self._known = self.server.connection_of(self.request)

    def parse_request(self) -> bool:
        whole = super().parse_request()
        self.server.lanes.served(self._known)
        return whole

    def handle_one_request(self) -> None:
        super().handle_one_request()
        self.server.lanes.waits(self._known)
        # Whoever asks without a pause gets no more of the processor than a page needs.
        time.sleep(_PAUSE_S)
        if self.server.closed:
            self.close_connection = True

    def do_GET(self) -> None:
        if not self._admitted():
            return
        parts = urlsplit(self.path)
        if parts.path in _FILES:
            name, kind = _FILES[parts.path]
            file = resources.files("visctrl.viewers.web") / "page" / name
            self._answer(HTTPStatus.OK, file.read_bytes(), kind)
        elif not self._authorised():
            return
        elif parts.path == "/about":
            self._answer_json(self.server.view.about())
        elif parts.path == "/state":
            self._state(parse_qs(parts.query))
        elif parts.path == "/image":
            self._image()
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such page")

    def do_POST(self) -> None:
        # A body that nobody asked for must not be taken for the next request.
        self.close_connection = True
        if not self._admitted() or not self._authorised():
            return
        if urlsplit(self.path).path != "/stop":
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such page")
            return
        self.server.stop.make(f"stopped on the page, from {self.client_address[0]}")
        self._answer_json({"stopped": True})

    def _admitted(self) -> bool:
        """Answer a request under a name that is not ours, or from another site's page."""
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin", "")
        access = self.server.access
        if access.knows_host(host) and access.same_origin(origin, host):
            return True
        self._refuse(HTTPStatus.FORBIDDEN, "this is not the page's own address")
        return False

    def _authorised(self) -> bool:
        if self.server.access.has_token(self.headers.get("Authorization", "")):
            self.server.lanes.welcome(self._known)
            return True
        time.sleep(PENALTY_S)
        self._refuse(HTTPStatus.UNAUTHORIZED, "the token is missing or wrong")
        return False

    def _state(self, query: dict[str, list[str]]) -> None:
        edition, known = (
            int(text) if (text := query.get(name, ["0"])[0]).isdecimal() else 0
            for name in ("edition", "known")
        )
        self.server.looked_at = time.monotonic()
        ended = self.server.view.ended
        state = self.server.view.state(edition, known)
        self._answer_json({**state, "stopped": self.server.stop.made})
        if ended:
            self.server.end_seen.set()

    def _image(self) -> None:
        _, data = self.server.view.image()
        if data:
            self._answer(HTTPStatus.OK, data, "image/jpeg")
        else:
            self._answer(HTTPStatus.NO_CONTENT, b"", "image/jpeg")

    def _answer_json(self, data: Any) -> None:
        text = json.dumps(data, separators=(",", ":"))
        self._answer(HTTPStatus.OK, text.encode(), "application/json")

    def _refuse(self, status: HTTPStatus, reason: str) -> None:
        self.close_connection = True
        self._answer(status, f"{reason}\n".encode(), "text/plain; charset=utf-8")

    def _answer(self, status: HTTPStatus, data: bytes, kind: str) -> None:
        self.send_response(status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        if status != HTTPStatus.NO_CONTENT:
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Keep requests off the terminal, where the progress of the run is shown."""


def _own_address() -> str:
    """Return this machine's address in its network, as a guess: no packet is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
            return str(probe.getsockname()[0])
        except OSError:
            return socket.gethostname()
