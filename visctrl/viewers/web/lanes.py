"""Who may occupy a server: strangers make room for each other, known guests keep a lane."""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

#: Connections that have not shown yet that they may ask, and of one address.
_STRANGERS, _OF_ONE_PEER = 96, 64
#: Connections that have: browsers and viewers, each with a few.
_GUESTS = 32
#: A request must be there, whole, so long after the connection or the last answer (s).
REQUEST_S, PAUSE_S = 3.0, 5.0
#: A wrong token is answered so late (s), which limits how many can be tried.
PENALTY_S = 0.5
#: Where strangers push each other out, the next one is let in so much later (s): a flood gets no
#: more of the processor than that leaves it.
_CROWDED_S = 0.003


@dataclass(eq=False)
class Connection:
    """A connection and what is known of its other end.

    deadline : by when its request must be whole; infinite while one is served.
    guest : whether it has made a request that was admitted.
    """

    socket: socket.socket
    peer: str
    deadline: float
    guest: bool = False


class Lanes:
    """Decides which connections stay, so that a new one is always let in.

    Where there are too many strangers, the oldest one leaves: of the address that has the most.
    An honest request comes whole within a moment, so flooding the server does not keep others
    out. Guests are not counted among strangers; of too many, the one that was quiet longest
    leaves.

    Parameters
    ----------
    clock, sleep : callable
        A steady time (s), and what waits for so long.
    """

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self._clock, self._sleep = clock, sleep
        self._lock = threading.Lock()
        #: In the order of their arrival, guests in that of their last request.
        self._all: list[Connection] = []

    def __len__(self) -> int:
        with self._lock:
            return len(self._all)

    def admit(self, connection: socket.socket, peer: str) -> Connection:
        """Take a new connection, for which others may have to leave."""
        new = Connection(connection, peer, self._clock() + REQUEST_S)
        with self._lock:
            self._all.append(new)
            strangers = [each for each in self._all if not each.guest]
            counts = Counter(each.peer for each in strangers)
            crowd = max(counts, key=lambda name: counts[name])
            if counts[peer] > _OF_ONE_PEER:
                crowd = peer
            crowded = counts[crowd] > _OF_ONE_PEER or len(strangers) > _STRANGERS
            if crowded:
                self._dismiss(next(each for each in strangers if each.peer == crowd))
        if crowded:
            self._sleep(_CROWDED_S)
        return new

    def welcome(self, connection: Connection) -> None:
        """Make a connection a guest: it has asked for something that it may have."""
        with self._lock:
            if connection not in self._all:
                return
            connection.guest = True
            self._all.remove(connection)
            self._all.append(connection)
            guests = [each for each in self._all if each.guest]
            if len(guests) > _GUESTS:
                self._dismiss(guests[0])

    def served(self, connection: Connection) -> None:
        """Hear that a request is whole: serving it may take its time."""
        connection.deadline = math.inf

    def waits(self, connection: Connection) -> None:
        """Hear that a request has been answered: the next one is due."""
        connection.deadline = self._clock() + PAUSE_S

    def leave(self, connection: Connection) -> None:
        """Forget a connection that has ended."""
        with self._lock, contextlib.suppress(ValueError):
            self._all.remove(connection)

    def dismiss_late(self) -> None:
        """End the connections whose request is overdue, however many bytes they trickle."""
        now = self._clock()
        with self._lock:
            for each in [each for each in self._all if each.deadline < now]:
                self._dismiss(each)

    def dismiss_all(self) -> None:
        """End every connection."""
        with self._lock:
            for each in list(self._all):
                self._dismiss(each)

    def _dismiss(self, connection: Connection) -> None:
        self._all.remove(connection)
        # Its thread, if it reads or writes, wakes up and ends.
        with contextlib.suppress(OSError):
            connection.socket.shutdown(socket.SHUT_RDWR)
