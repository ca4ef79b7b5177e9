"""A record of what a client sent, and whether all of it was legal."""

from __future__ import annotations

import json
import threading
from dataclasses import dataclass
from typing import TextIO

from visctrl.hal.pioneer.commands import Command, decode_command, objection
from visctrl.hal.pioneer.packet import Packet

#: Commands must not follow each other more closely (s).
LEAST_SPACING_S = 0.005


@dataclass(frozen=True)
class Entry:
    """A packet, received some time in [earliest, latest] (s): between two looks at the line."""

    earliest: float
    latest: float
    packet: Packet


class Traffic:
    """Everything received from clients, in memory and, if wanted, in a file of JSON lines.

    Parameters
    ----------
    file : text file or None
        Receives a line per packet, and a ``truth`` line per `note_truth`.
    """

    def __init__(self, file: TextIO | None = None) -> None:
        self._file = file
        self._lock = threading.Lock()
        self._entries: list[Entry] = []
        #: Received bytes that belong to no packet.
        self.garbage = 0

    def add(self, earliest: float, latest: float, packet: Packet) -> None:
        """Record a packet."""
        with self._lock:
            self._entries.append(Entry(earliest, latest, packet))
        self._write(
            {
                "t": round(latest, 4),
                "hex": packet.encode().hex(),
                "command": str(decode_command(packet)),
            }
        )

    def note_truth(self, t: float, pose: tuple[float, ...], velocity: tuple[float, ...]) -> None:
        """Record where the robot truly is: (x, y, φ) and (v, ω)."""
        if self._file is not None:
            self._write({"t": round(t, 4), "truth": [round(float(v), 6) for v in pose + velocity]})

    @property
    def entries(self) -> tuple[Entry, ...]:
        """All packets so far."""
        with self._lock:
            return tuple(self._entries)

    def commands(self) -> list[Command]:
        """Return all commands so far."""
        return [decode_command(entry.packet) for entry in self.entries]

    def violations(self) -> list[str]:
        """Return what was not legal, as sentences; empty for a correct client.

        Each packet must be a command that the firmware takes, whoever sends it; nothing may come
        in between, and no two commands closer together than the firmware can take them.
        """
        found = [f"{self.garbage} bytes outside packets"] if self.garbage else []
        arrival = float("-inf")
        for entry in self.entries:
            at = f"at {entry.latest:.3f} s: {decode_command(entry.packet)}"
            if problem := objection(entry.packet):
                found.append(f"{at} {problem}")
            # The earliest arrivals that fit what was seen; if even those are too late, so were
            # the true ones too close.
            arrival = max(arrival + LEAST_SPACING_S, entry.earliest)
            if arrival > entry.latest:
                found.append(f"{at} came too soon after the command before it")
                arrival = entry.latest
        return found

    def _write(self, line: dict[str, object]) -> None:
        if self._file is not None:
            with self._lock:
                self._file.write(json.dumps(line) + "\n")
                self._file.flush()
