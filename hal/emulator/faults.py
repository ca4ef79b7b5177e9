"""What goes wrong with the emulated robot, its line and its camera, and when."""

from __future__ import annotations

import random
import re
import threading
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from visctrl.hal.errors import InputError
from visctrl.robots.documents import suggestion

#: Kinds of fault, with the default value of those that have one.
KINDS: dict[str, float | None] = {
    "lost": 0.02,
    "corrupt": 0.02,
    "delay": 0.1,
    "silent": None,
    "deaf": None,
    "rubbish": None,
    "reset": 255.0,
    "stall": None,
    "bumper": None,
    "estop": None,
    "charging": None,
    "low-battery": 10.5,
    "camera-frozen": None,
    "camera-dropped": None,
}

#: Least and greatest value of a fault that has one.
_RANGES = {
    "lost": (0.0, 1.0),
    "corrupt": (0.0, 1.0),
    "delay": (0.0, 60.0),
    "reset": (254.0, 255.0),
    "low-battery": (0.0, 25.0),
}

_TEXT = re.compile(
    r"(?P<kind>[a-z-]+)(=(?P<value>[0-9.]+))?(@(?P<start>[0-9.]+)(\+(?P<length>[0-9.]+))?)?"
)


@dataclass(frozen=True)
class Fault:
    """One fault.

    kind : one of `KINDS`.
    value : probability per byte (lost, corrupt), seconds (delay), volts (low-battery), type of
        the packet that says so (reset: 255 or 254).
    start : seconds after the robot first moves; None for a fault that is always there.
    length : how long it lasts (s); None for ever.
    """

    kind: str
    value: float | None = None
    start: float | None = None
    length: float | None = None

    def active(self, since_motion: float | None) -> bool:
        """Return whether it acts, so many seconds after the first motion (None: not yet)."""
        if self.start is None:
            return True
        if since_motion is None or since_motion < self.start:
            return False
        return self.length is None or since_motion < self.start + self.length


def parse_fault(text: str) -> Fault:
    """Read ``KIND[=VALUE][@START[+LENGTH]]``, for example ``lost=0.05@2+1``.

    Raises
    ------
    InputError
        It is not of that form, or there is no such kind.
    """
    match = _TEXT.fullmatch(text)
    if match is None:
        raise InputError(f"fault '{text}': expected KIND[=VALUE][@START[+LENGTH]], times in s")
    kind = match["kind"]
    if kind not in KINDS:
        raise InputError(f"unknown fault '{kind}'; {suggestion(kind, KINDS)}")
    if match["value"] is not None and KINDS[kind] is None:
        raise InputError(f"fault '{kind}' takes no value")
    try:
        value, start, length = (
            None if match[name] is None else float(match[name])
            for name in ("value", "start", "length")
        )
    except ValueError:
        raise InputError(f"fault '{text}': its numbers cannot be read") from None
    if value is not None:
        low, high = _RANGES[kind]
        if not low <= value <= high:
            raise InputError(f"fault '{text}': its value lies between {low:g} and {high:g}")
    return Fault(kind, KINDS[kind] if value is None else value, start, length)


class FaultSchedule:
    """The faults of one emulation; more can be switched on and off while it runs."""

    def __init__(self, faults: Iterable[Fault] = ()) -> None:
        self._faults = list(faults)
        self._switched: dict[str, Fault] = {}
        self._active: dict[str, Fault] = {}
        self._lock = threading.Lock()
        self.update(None)

    def update(self, since_motion: float | None) -> None:
        """Take note of the time: seconds after the first motion, None before it."""
        with self._lock:
            active = {f.kind: f for f in self._faults if f.active(since_motion)}
            self._active = {**active, **self._switched}

    def switch_on(self, kind: str, value: float | None = None) -> None:
        """Let a fault begin now."""
        with self._lock:
            fault = Fault(kind, KINDS[kind] if value is None else value)
            self._switched[kind] = self._active[kind] = fault

    def switch_off(self, kind: str) -> None:
        """Let a fault that was switched on end now."""
        with self._lock:
            self._switched.pop(kind, None)
            self._active.pop(kind, None)

    def __contains__(self, kind: str) -> bool:
        return kind in self._active

    def value(self, kind: str) -> float:
        """Return the value of a fault; 0 if it is not active."""
        fault = self._active.get(kind)
        return 0.0 if fault is None or fault.value is None else fault.value


class Channel:
    """One direction of the line: loses, corrupts and delays bytes as the schedule says."""

    def __init__(self, faults: FaultSchedule, seed: int) -> None:
        self._faults = faults
        self._chance = random.Random(seed)
        self._waiting: deque[tuple[float, bytes]] = deque()

    def put(self, t: float, data: bytes) -> None:
        """Let bytes enter at ``t`` (s)."""
        lost, corrupt = self._faults.value("lost"), self._faults.value("corrupt")
        if lost:
            data = bytes(byte for byte in data if self._chance.random() >= lost)
        if corrupt:
            data = bytes(self._damaged(byte, corrupt) for byte in data)
        if data:
            self._waiting.append((t + self._faults.value("delay"), data))

    def take(self, t: float) -> bytes:
        """Return the bytes that have come out by ``t`` (s), in the order they entered."""
        out = b""
        while self._waiting and self._waiting[0][0] <= t:
            out += self._waiting.popleft()[1]
        return out

    def clear(self) -> None:
        """Forget what is under way."""
        self._waiting.clear()

    def rubbish(self, count: int) -> bytes:
        """Return random bytes."""
        return self._chance.randbytes(count)

    def _damaged(self, byte: int, probability: float) -> int:
        hit = self._chance.random() < probability
        return byte ^ (1 << self._chance.randrange(8)) if hit else byte
