"""How long the driver waits before it acts, and what a serial line can carry. No I/O.

The limits follow from the robot's report cycle, which is 100 ms as delivered and can be set to
anything between 1 and 255 ms, and from the line's round trip.
"""

from __future__ import annotations

from dataclasses import dataclass

#: A longer round trip is worth a word (s): serial lines take a few ms, networks some tens.
SLOW_S = 0.2
#: Report cycle as delivered (s).
_CYCLE_S = 0.1
#: Bits on the line for a byte: start, eight, stop.
_BITS = 10
#: Share of the line above which reports begin to queue behind each other and behind the rest.
_HEAVY = 0.8


@dataclass(frozen=True)
class Timing:
    """Limits in s.

    cycle_s : of the robot's reports. round_trip_s : from a packet to its answer.
    """

    cycle_s: float = _CYCLE_S
    round_trip_s: float = 0.0

    @classmethod
    def of(cls, report_cycle_ms: int | None, round_trip_s: float) -> Timing:
        """Return the limits for what the robot's configuration says (None: it does not say)."""
        cycle = report_cycle_ms / 1e3 if report_cycle_ms else _CYCLE_S
        return cls(cycle, round_trip_s)

    @property
    def blind_s(self) -> float:
        """Without a report for so long, the robot is stopped: one and a half cycles are missing.

        At 100 ms three reports in a row are; a loaded computer may be late by one.
        """
        return max(0.35, 1.5 * self.cycle_s + 0.1)

    @property
    def silent_s(self) -> float:
        """Without a report for so long, the line counts as dead."""
        return max(0.5, 2.5 * self.cycle_s + 0.1)

    @property
    def disobedient_s(self) -> float:
        """A robot that stands for so long although told to move does not hear, or is held."""
        return 1.5 + self.round_trip_s


@dataclass(frozen=True)
class LineLoad:
    """What the robot's reports take of a serial line."""

    baud: int
    report_bytes: int
    cycle_s: float

    @property
    def share(self) -> float:
        """Share of the line's capacity that the reports take."""
        return self.report_bytes * _BITS / self.baud / self.cycle_s

    @property
    def heavy(self) -> bool:
        """Whether reports leave the line too little room."""
        return self.share > _HEAVY

    def __str__(self) -> str:
        took = 1e3 * self.report_bytes * _BITS / self.baud
        text = (
            f"at {self.baud} baud a report of {self.report_bytes} bytes takes {took:.0f} ms of a "
            f"cycle of {1e3 * self.cycle_s:.0f} ms"
        )
        if not self.heavy:
            return text
        return (
            f"{text}: the line is full, reports come late; set the robot's parameter HostBaud "
            "higher, or AutoBaud to 2"
        )
