"""Connecting: find the line's rate, take over a robot that is still open, synchronise."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from visctrl.hal.errors import LinkError
from visctrl.hal.pioneer.commands import Command, Id
from visctrl.hal.pioneer.link import Link
from visctrl.hal.pioneer.packet import Packet
from visctrl.hal.pioneer.reports import (
    SYNC_TYPES,
    Identity,
    ReportError,
    decode_identity,
    is_standard_report,
)

#: Rates in the order of their likelihood.
BAUDS = (9600, 38400, 19200, 115200, 57600)

#: Long enough to hear two reports of a robot that is still open.
_LISTEN_S = 0.25
_REPLY_S = 0.35
_ROUNDS = 2
_RESTARTS = 4
#: A robot that still reports after so many CLOSE commands does not obey.
_CLOSE_TRIES = 8
_QUIET_S = 0.25

_log = logging.getLogger(__name__)


def connect(link: Link, bauds: Sequence[int] = BAUDS) -> Identity:
    """Bring the robot from any state to "connected" and return who it is.

    It listens before it talks: a robot left open by a dead client gets CLOSE as the first
    packet, never one that would only feed its watchdog and keep it moving.

    Raises
    ------
    LinkError
        Nothing answers, or what answers is no robot.
    """
    heard = False
    for round_number in range(_ROUNDS):
        for baud in bauds if link.has_baud else bauds[:1]:
            link.set_baud(baud)
            identity = _try_rate(link, talk_into_noise=round_number > 0)
            heard = heard or link.noise > 0
            if identity is not None:
                _log.info("%s answers at %d baud", link.url, baud)
                return identity
    what = "only noise arrives; is something else connected there?" if heard else "silence"
    raise LinkError(
        f"port {link.url}: no robot answers ({what}). Check that it is switched on and that no "
        "other program talks to it"
    )


def _try_rate(link: Link, *, talk_into_noise: bool) -> Identity | None:
    """Return the robot's identity, or None if nothing answers at the present rate."""
    if any(_is_open_robot(packet) for packet in link.receive_for(_LISTEN_S)):
        _take_over(link)
    elif link.noise and not talk_into_noise:
        return None  # somebody is sending at another rate
    for _ in range(_RESTARTS):
        outcome = _synchronise(link)
        if isinstance(outcome, Identity):
            return outcome
        if outcome is None:
            return None
        if _is_open_robot(outcome):
            _take_over(link)
    return None


def _synchronise(link: Link) -> Identity | Packet | None:
    """Exchange SYNC0, 1, 2: the identity, the packet that came instead, or None for silence."""
    reply: Packet | None = None
    for number in (Id.PULSE, Id.OPEN, Id.CLOSE):
        link.send(Command(number))
        reply = next(link.receive_for(_REPLY_S), None)
        if reply is None or reply.id != number:
            return reply
    assert reply is not None
    try:
        return decode_identity(reply)
    except ReportError as error:
        raise LinkError(f"port {link.url}: {error}; it seems to echo what it is sent") from None


def _is_open_robot(packet: Packet) -> bool:
    """Return whether only a robot in an open session sends such a packet."""
    return is_standard_report(packet) or (packet.id not in SYNC_TYPES and packet.id < 0xFE)


def _take_over(link: Link) -> None:
    """Close the session that a robot is in; CLOSE also stops it.

    Raises
    ------
    LinkError
        It goes on reporting.
    """
    _log.warning("the robot on %s is still in a session: closing that", link.url)
    for _ in range(_CLOSE_TRIES):
        link.send(Command(Id.CLOSE))
        if not any(_is_open_robot(packet) for packet in link.receive_for(_QUIET_S)):
            return
    raise LinkError(
        f"port {link.url}: the robot stays in its session; is another program driving it?"
    )
