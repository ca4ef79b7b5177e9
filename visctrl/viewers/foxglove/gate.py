"""The door before the live viewer's server, which itself lets everybody in.

Foxglove's server takes any connection, also one that a page of another site makes. It listens
where nobody looks for it: at a port and, where the system has more than one of its own, an address
drawn at random. Whoever comes to the address that was asked for is let through to it if Host,
Origin and token are right.
"""

from __future__ import annotations

import contextlib
import hmac
import secrets
import socket
import sys
import threading
from http import HTTPStatus
from urllib.parse import parse_qs, urlsplit

from visctrl.viewers.web.address import Access, Address
from visctrl.viewers.web.lanes import PENALTY_S, Connection, Lanes

#: Bytes of a request for a WebSocket.
_MOST_HEAD = 16_384
_CHUNK = 65_536
_POLL_S = 0.1
#: A server on this machine answers within this time (s).
_NEAR_S = 2.0


def hidden_address() -> Address:
    """Return an address of this machine that nobody can guess; port 0 is to be drawn, too."""
    if sys.platform != "linux":  # others have one loopback address
        return Address("127.0.0.1", 0)
    parts = (str(1 + secrets.randbelow(254)) for _ in range(3))
    return Address(f"127.{'.'.join(parts)}", 0)


class Gate:
    """Lets viewers through to a WebSocket server; threads of its own do the work.

    Parameters
    ----------
    address : Address
        Where viewers come to.
    hidden : Address
        Where the server listens.
    token : str
        What a viewer must show, as ``?token=...``.

    Raises
    ------
    OSError
        It is not possible to listen there.
    """

    def __init__(self, address: Address, hidden: Address, token: str) -> None:
        self._hidden = hidden
        self._door = socket.create_server(
            (address.host, address.port), family=address.family, backlog=128
        )
        self._door.settimeout(_POLL_S)
        #: Where it listens.
        self.address = Address(address.host, self._door.getsockname()[1])
        self._access = Access(self.address, token)
        self._lanes = Lanes()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="gate", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """What a viewer is to open."""
        return f"{self.address.url().replace('http', 'ws', 1)}?token={self._access.token}"

    def close(self) -> None:
        """Let nobody through any more."""
        self._closed.set()
        self._thread.join()
        self._door.close()
        self._lanes.dismiss_all()

    def _listen(self) -> None:
        while not self._closed.is_set():
            self._lanes.dismiss_late()
            try:
                viewer, peer = self._door.accept()
            except OSError:  # nobody came, or the one who came has left
                continue
            known = self._lanes.admit(viewer, str(peer[0]))
            threading.Thread(target=self._receive, args=(known,), daemon=True).start()

    def _receive(self, known: Connection) -> None:
        viewer = known.socket
        with viewer, contextlib.suppress(OSError):
            try:
                head, rest = _read_head(viewer)
                self._lanes.served(known)
                request, _, _ = head.partition("\r\n")
                refusal = self._refusal(request, _fields(head))
                if refusal is not None:
                    _refuse(viewer, refusal)
                    return
                self._lanes.welcome(known)
                self._let_through(viewer, head, rest)
            finally:
                self._lanes.leave(known)

    def _refusal(self, request: str, fields: dict[str, str]) -> HTTPStatus | None:
        """Return why a viewer must stay outside, None if it may come in."""
        method, _, target = request.partition(" ")
        if method != "GET" or fields.get("upgrade", "").lower() != "websocket":
            return HTTPStatus.BAD_REQUEST
        host = fields.get("host", "")
        if not (self._access.knows_host(host) and self._access.is_viewer(fields.get("origin", ""))):
            return HTTPStatus.FORBIDDEN
        shown = parse_qs(urlsplit(target.partition(" ")[0]).query).get("token", [""])[0]
        if hmac.compare_digest(shown.encode(), self._access.token.encode()):
            return None
        self._closed.wait(PENALTY_S)
        return HTTPStatus.UNAUTHORIZED

    def _let_through(self, viewer: socket.socket, head: str, rest: bytes) -> None:
        """Carry bytes both ways until either end leaves; a viewer that does not read waits."""
        _, _, fields = head.partition("\r\n")
        where = (self._hidden.host, self._hidden.port)
        viewer.settimeout(None)
        with socket.create_connection(where, timeout=_NEAR_S) as server:
            server.settimeout(None)
            server.sendall(f"GET / HTTP/1.1\r\n{fields}".encode("latin-1") + rest)
            back = threading.Thread(target=_carry, args=(server, viewer), daemon=True)
            back.start()
            _carry(viewer, server)
            back.join()


def _read_head(viewer: socket.socket) -> tuple[str, bytes]:
    """Return a request's head, its end included, and what has come after it."""
    data = b""
    while b"\r\n\r\n" not in data:
        part = viewer.recv(_MOST_HEAD)
        if not part or len(data) > _MOST_HEAD:
            raise ConnectionError("no request has come")
        data += part
    head, _, rest = data.partition(b"\r\n\r\n")
    return head.decode("latin-1") + "\r\n\r\n", rest


def _fields(head: str) -> dict[str, str]:
    """Return the fields of a request's head; of one given twice, what no check lets pass."""
    found: dict[str, str] = {}
    for line in head.split("\r\n")[1:]:
        name, colon, value = line.partition(":")
        if colon:
            name = name.strip().lower()
            found[name] = "," if name in found else value.strip()
    return found


def _refuse(viewer: socket.socket, status: HTTPStatus) -> None:
    text = f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Length: 0\r\n"
    viewer.sendall(f"{text}Connection: close\r\n\r\n".encode())


def _carry(source: socket.socket, sink: socket.socket) -> None:
    """Pass on what comes until one end leaves; then the other is told."""
    with contextlib.suppress(OSError):
        while data := source.recv(_CHUNK):
            sink.sendall(data)
    for end in (source, sink):
        with contextlib.suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)
