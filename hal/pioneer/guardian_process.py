"""Dead man's switch over a line: stop packets, when beats are overdue or their pipe ends.

Run as a program by `guardian.Guardian`, so that nothing of the watched process is needed here: it
imports nothing but a few modules of the standard library.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import struct
import sys
import time
from collections.abc import Sequence

#: A beat: until when (s, monotonic clock of the system) the line need not be stopped.
BEAT = struct.Struct("=d")
#: The robot stands: no beat is due. The driver has finished: nothing is to be stopped any more.
STANDING, FAREWELL = float("inf"), float("-inf")
#: What it says on stdout once it watches.
READY = b"."

#: How often all packets are sent: the watched process may have left half a packet on the line,
#: which costs the next one, and a line may damage some.
_ROUNDS = 3
#: Time between packets (s), which the firmware needs.
_SPACING_S = 0.006
#: How long to wait for room where a line takes no bytes (s).
_ROOM_S = 0.05
_CHUNK = 4096


def watch(beats: int, line: int, stop: Sequence[bytes]) -> None:
    """Stop whenever a beat is overdue, and when no more can come; return then or on farewell.

    Parameters
    ----------
    beats, line : int
        Descriptors: a pipe of `BEAT`, and where ``stop`` is written.
    stop : sequence of bytes
        Packets, each written at once.
    """
    due, unread = STANDING, b""
    while True:
        patience = None if due == STANDING else max(0.0, due - time.monotonic())
        if not select.select([beats], [], [], patience)[0]:
            send(line, stop)
            due = STANDING  # what has been stopped need not be stopped again
            continue
        data = os.read(beats, _CHUNK)
        if not data:
            send(line, stop)
            return
        unread += data
        whole = len(unread) - len(unread) % BEAT.size
        for (beat,) in BEAT.iter_unpack(unread[:whole]):
            if beat == FAREWELL:
                return
            due = beat
        unread = unread[whole:]


def send(line: int, packets: Sequence[bytes]) -> None:
    """Write packets, a few times over, as far as the line takes them."""
    for _ in range(_ROUNDS):
        for packet in packets:
            with contextlib.suppress(OSError):  # a dead line leaves nothing to be done
                select.select([], [line], [], _ROOM_S)
                os.write(line, packet)
            time.sleep(_SPACING_S)


def main() -> None:
    """Watch stdin for the line and the packets that the arguments name."""
    # It ends when the watched process does; what ends that one must not end this one first.
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT"):
        signal.signal(signal.Signals[name], signal.SIG_IGN)
    line, *stop = sys.argv[1:]
    ready = sys.stdout.fileno()
    os.write(ready, READY)
    os.close(ready)
    watch(sys.stdin.fileno(), int(line), [bytes.fromhex(packet) for packet in stop])
    os._exit(0)  # nothing is left to be flushed


if __name__ == "__main__":
    main()
