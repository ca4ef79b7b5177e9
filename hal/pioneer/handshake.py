"""Connecting: find the line's rate, take over a robot that is still open, synchronise."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

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
#: Longest wait for a reply: a round trip of a second, and what the robot takes.
_SLOWEST_S = 1.1
#: A robot that still reports after so many CLOSE commands does not obey.
_CLOSE_TRIES = 8
_QUIET_S = 0.25
#: How often the exchange is begun anew at a rate at which a robot has answered: half of the
#: packets damaged in either direction, one in 64 exchanges succeeds.
_RESTARTS = 24


@dataclass(frozen=True)
class _Patience:
    """How long to try at one rate before the next.

    reply_s : longest wait for a reply. silent, noisy : attempts without any answer before giving
        up, where nothing arrives and where bytes do. talks_into_noise : whether to try at all
        where bytes arrive that are no packets (somebody may be sending at another rate).
    """

    reply_s: float
    silent: int
    noisy: int
    talks_into_noise: bool


#: One round over all rates for lines that answer at once, one for those that are slow.
_SEARCH = (_Patience(0.35, 2, 2, False), _Patience(_SLOWEST_S, 1, 3, True))
#: Two rounds where there is but one rate.
_KNOWN_RATE = (_Patience(_SLOWEST_S, 3, 6, False), _Patience(_SLOWEST_S, 2, 6, True))


@dataclass(frozen=True)
class Contact:
    """A robot that has answered.

    round_trip_s : time from the last packet of the exchange to its reply, which no earlier
        attempt can have caused.
    """

    identity: Identity
    round_trip_s: float


@dataclass(frozen=True)
class _Exchange:
    """How far an exchange of sync packets came.

    contact : the robot, if it came to its end. echoed : whether anything was answered.
    intruder : a packet that came in place of a reply.
    """

    contact: Contact | None = None
    echoed: bool = False
    intruder: Packet | None = None


def connect(link: Link, bauds: Sequence[int] = BAUDS) -> Contact:
    """Bring the robot from any state to "connected" and return who it is.

    It listens before it talks: a robot left open by a dead client gets CLOSE as the first
    packet, never one that would only feed its watchdog and keep it moving. Where a reply stays
    out, or is damaged, the exchange begins anew with SYNC0, as the protocol has it.

    Raises
    ------
    LinkError
        Nothing answers, or what answers is no robot.
    """
    rates = tuple(bauds) if link.has_baud else tuple(bauds[:1])
    heard = False
    for patience in _KNOWN_RATE if len(rates) == 1 else _SEARCH:
        for baud in rates:
            link.set_baud(baud)
            contact = _try_rate(link, patience)
            heard = heard or link.noise > 0
            if contact is not None:
                where = f" at {baud} baud" if link.has_baud else ""
                _log.info("%s answers%s in %.2f s", link.url, where, contact.round_trip_s)
                return contact
    what = "only noise arrives; is something else connected there?" if heard else "silence"
    raise LinkError(
        f"port {link.url}: no robot answers ({what}). Check that it is switched on and that no "
        "other program talks to it"
    )


def _try_rate(link: Link, patience: _Patience) -> Contact | None:
    """Return the robot, or None if nothing answers at the present rate."""
    if any(_is_open_robot(packet) for packet in link.receive_for(_LISTEN_S)):
        _take_over(link)
    elif link.noise and not patience.talks_into_noise:
        return None  # somebody is sending at another rate
    unanswered, reply_s = 0, patience.reply_s
    for _ in range(_RESTARTS):
        before = link.noise
        exchange = _synchronise(link, reply_s)
        if exchange.contact is not None:
            return exchange.contact
        if exchange.intruder is not None and _is_open_robot(exchange.intruder):
            _take_over(link)
        elif exchange.echoed:
            reply_s = _SLOWEST_S  # somebody is there, and perhaps slow
        else:
            unanswered += 1
            if unanswered >= (patience.noisy if link.noise > before else patience.silent):
                return None
    return None


def _synchronise(link: Link, reply_s: float) -> _Exchange:
    """Exchange SYNC0, 1, 2 once."""
    reply: Packet | None = None
    round_trip = 0.0
    for number in (Id.PULSE, Id.OPEN, Id.CLOSE):
        link.send(Command(number))
        sent = link.last_sent
        # Of earlier attempts, replies may still be under way.
        late = SYNC_TYPES - {number}
        reply = next((each for each in link.receive_for(reply_s) if each.id not in late), None)
        if reply is None or reply.id != number:
            return _Exchange(None, number > Id.PULSE or reply is not None, reply)
        round_trip = max(0.0, reply.stamp - sent)
    assert reply is not None
    try:
        return _Exchange(Contact(decode_identity(reply), round_trip), True)
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


_log = logging.getLogger(__name__)
