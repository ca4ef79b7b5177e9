"""Where to listen, and who may ask: addresses, host names, tokens."""

from __future__ import annotations

import hmac
import ipaddress
import socket
from dataclasses import dataclass

from visctrl.robots.errors import InputError

LOOPBACK = "127.0.0.1"
#: Where Foxglove's app is run in a browser.
VIEWER_PAGE = "https://app.foxglove.dev"
_MOST = 65_535


@dataclass(frozen=True)
class Address:
    """A host and a TCP port; port 0 is any free one."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str, port: int, option: str) -> Address:
        """Read ``HOST:PORT``, ``HOST`` or ``PORT``; IPv6 addresses in brackets.

        Raises
        ------
        InputError
            It is none of these; the message names ``option``.
        """
        host, colon, number = text.rpartition(":")
        if text.isdigit():
            host, number = LOOPBACK, text
        elif not colon or text.endswith("]"):
            host, number = text, str(port)
        host = host.removeprefix("[").removesuffix("]") or LOOPBACK
        if not number.isdigit() or int(number) > _MOST or (":" in host and not _is_ip(host)):
            raise InputError(f"{option} {text}: expected HOST:PORT, as in 0.0.0.0:{port}")
        return cls(host, int(number))

    @property
    def is_loopback(self) -> bool:
        """Whether only programs on this machine can connect."""
        return self.host == "localhost" or (_is_ip(self.host) and _ip(self.host).is_loopback)

    @property
    def family(self) -> socket.AddressFamily:
        """IPv4 or IPv6."""
        return socket.AF_INET6 if ":" in self.host else socket.AF_INET

    def url(self, host: str = "") -> str:
        """Return the URL of the page."""
        name = host or self.host
        return f"http://{f'[{name}]' if ':' in name else name}:{self.port}/"


@dataclass(frozen=True)
class Access:
    """Who may look and stop.

    A page from elsewhere in the same browser could name this machine by a host name of its own
    (DNS rebinding), so the names by which we may be asked are few: on loopback its own, else
    IP addresses, which nobody can rebind, and this machine's names.

    token : what a request must show, empty if nothing.
    """

    address: Address
    token: str = ""

    def knows_host(self, header: str) -> bool:
        """Whether a ``Host`` header names this server."""
        name = _host_in(header)
        if self.address.is_loopback:
            return _is_own(name)
        own = socket.gethostname().lower()
        return _is_ip(name) or name in {"localhost", self.address.host.lower(), own, f"{own}.local"}

    def same_origin(self, origin: str, host: str) -> bool:
        """Whether a request comes from our own page, or from no page at all."""
        return not origin or origin == f"http://{host}"

    def is_viewer(self, origin: str) -> bool:
        """Whether an ``Origin`` header is that of a viewer: an app, Foxglove's page, or ours.

        Pages of the web come over http and https, or say ``null`` where they hide it.
        """
        scheme, _, host = origin.lower().partition("://")
        if scheme in ("http", "https"):
            return origin == VIEWER_PAGE or _is_own(_host_in(host))
        return scheme != "null"

    def has_token(self, authorization: str) -> bool:
        """Whether an ``Authorization`` header shows the token."""
        shown = authorization.removeprefix("Bearer ").strip()
        return not self.token or hmac.compare_digest(shown.encode(), self.token.encode())


def _is_own(name: str) -> bool:
    """Whether a host name is this machine's loopback."""
    return name == "localhost" or (_is_ip(name) and _ip(name).is_loopback)


def _host_in(header: str) -> str:
    text = header.strip().lower()
    if text.startswith("["):
        return text[1:].partition("]")[0]
    return text.rpartition(":")[0] if ":" in text else text


def _is_ip(text: str) -> bool:
    try:
        _ip(text)
    except ValueError:
        return False
    return True


def _ip(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    return ipaddress.ip_address(text)
