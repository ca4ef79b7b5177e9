"""Packets of the ARCOS serial protocol, and finding them in a stream of bytes. No I/O.

A packet is ``FA FB | N | id | data (N - 3 bytes) | checksum``: N counts what follows it. The
checksum is the one of the Pioneer 3 Operations Manual, chapter 6.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

HEADER = b"\xfa\xfb"
#: Bytes around the data: header, count, id, checksum.
OVERHEAD = 6
#: Smallest and largest count byte that may arrive.
MIN_COUNT, MAX_COUNT = 3, 255
#: The manuals disagree on the largest count the firmware takes (204 or 249); below both.
MAX_SENT_COUNT = 200

# Bounds the work on garbage that is full of headers.
_SLICE = 512


def checksum(body: bytes) -> int:
    """Return the 16-bit checksum of ``body``, the bytes from the id to the last data byte.

    Sum of big-endian byte pairs modulo 65536; an odd last byte is XORed into the low byte.
    """
    total = sum(body[0:-1:2]) * 256 + sum(body[1::2])
    total &= 0xFFFF
    return total ^ body[-1] if len(body) % 2 else total


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet in either direction.

    id : command number (to the robot) or packet type (from it).
    data : the bytes between the id and the checksum.
    stamp : when its first byte arrived (s); not part of its identity.
    """

    id: int
    data: bytes = b""
    stamp: float = field(default=0.0, compare=False)

    def encode(self) -> bytes:
        """Return the packet's bytes on the wire.

        Raises
        ------
        ValueError
            The id is not a byte, or the data do not fit into a packet.
        """
        body = bytes([self.id]) + self.data
        count = len(body) + 2
        if count > MAX_COUNT:
            raise ValueError(f"{len(self.data)} data bytes do not fit into a packet")
        return HEADER + bytes([count]) + body + checksum(body).to_bytes(2, "big")


class StreamDecoder:
    """Finds packets in bytes that arrive in pieces of any size, between garbage of any kind.

    The packet that *ends first* wins: after every byte, each header seen since the last packet
    is a possible beginning, and the first whose count and checksum agree is taken. So a header
    in garbage, whatever its count, can neither swallow a packet nor make it wait, and the
    result does not depend on how the bytes were cut into pieces.

    The end of a packet may be the beginning of the next one's header: garbage before a packet
    can, with the first bytes of that, make a false one whose checksum fits (``FA FB 03 FA 00``
    does, before any packet).
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._offset = 0  # of the buffer's first byte in the stream
        self._shared = 0  # bytes in front that already belong to a packet
        self._arrivals: deque[tuple[int, float]] = deque()
        #: Bytes so far that belong to no packet (those still undecided not counted).
        self.discarded = 0

    @property
    def pending(self) -> int:
        """Bytes of no packet so far that may still become part of one."""
        return len(self._buffer) - self._shared

    @property
    def wanted(self) -> int:
        """Bytes, at least one, without which no packet can be completed: read that many.

        With nothing pending it is one, so that the stamp of a packet is that of its first byte.
        """
        if not self.pending:
            return 1
        have = len(self._buffer)
        missing = [end - have for _, end in self._candidates() if end > have]
        begun = have - self._first_begun(have)
        if begun:
            missing.append(OVERHEAD - begun)
        return min(missing, default=1)

    def feed(self, data: bytes, stamp: float = 0.0) -> list[Packet]:
        """Take bytes that arrived at ``stamp`` (s) and return the packets they complete."""
        packets: list[Packet] = []
        for start in range(0, len(data), _SLICE):
            self._arrivals.append((self._offset + len(self._buffer), stamp))
            self._buffer += data[start : start + _SLICE]
            while (found := self._first_complete()) is not None:
                first, end = found
                body = bytes(self._buffer[first + 3 : end - 2])
                packets.append(Packet(body[0], body[1:], self._arrival(first)))
                self.discarded += max(0, first - self._shared)
                begun = self._first_begun(end)
                self._drop(begun)
                self._shared = end - begun
            keep = self._first_open()
            self.discarded += max(0, keep - self._shared)
            self._drop(keep)
        return packets

    def _candidates(self) -> list[tuple[int, int]]:
        """Return (first, end) in the buffer of every beginning whose count byte has arrived."""
        found = []
        first = self._buffer.find(HEADER)
        while 0 <= first < len(self._buffer) - 2:
            count = self._buffer[first + 2]
            if count >= MIN_COUNT:
                found.append((first, first + 3 + count))
            first = self._buffer.find(HEADER, first + 1)
        return found

    def _first_complete(self) -> tuple[int, int] | None:
        """Return the valid packet that ends first (of two, the longer one)."""
        have = len(self._buffer)
        ended = [(end, first) for first, end in self._candidates() if end <= have]
        for end, first in sorted(ended):
            body = bytes(self._buffer[first + 3 : end - 2])
            if checksum(body) == int.from_bytes(self._buffer[end - 2 : end], "big"):
                return first, end
        return None

    def _first_open(self) -> int:
        """Return where the first beginning is that may still become a packet."""
        have = len(self._buffer)
        for first, end in self._candidates():
            if end > have:
                return first
        return self._first_begun(have)

    def _first_begun(self, end: int) -> int:
        """Return where a header begins that ``end`` cuts before its count byte, or ``end``."""
        if self._buffer[max(0, end - 2) : end] == HEADER:
            return end - 2
        return end - 1 if self._buffer[end - 1 : end] == HEADER[:1] else end

    def _arrival(self, first: int) -> float:
        position = self._offset + first
        while len(self._arrivals) > 1 and self._arrivals[1][0] <= position:
            self._arrivals.popleft()
        return self._arrivals[0][1]

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._offset += count
        self._shared = max(0, self._shared - count)
        while len(self._arrivals) > 1 and self._arrivals[1][0] <= self._offset:
            self._arrivals.popleft()
