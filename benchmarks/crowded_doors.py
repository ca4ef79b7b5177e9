"""How late ticks are while hundreds of hostile connections occupy the page and the live viewer.

    python benchmarks/crowded_doors.py --seconds 60 --connections 500

One run on the wall clock at 10 Hz; every few seconds a process of its own begins or ends to hold
that many connections open, half of them on each door, and to trickle bytes into them; what is
dismissed comes back at once. The two halves of the run are compared: same run, same machine.
"""

from __future__ import annotations

import argparse
import contextlib
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Sequence

import numpy as np

from visctrl.runtime.config import load_scenario, parse_setting
from visctrl.runtime.plan import Plan, make_plan
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.session import run_session
from visctrl.runtime.stop import StopRequest
from visctrl.viewers.foxglove.stream import ViewerStream
from visctrl.viewers.web.address import Address
from visctrl.viewers.web.server import WebPage
from visctrl.viewers.web.view import LiveView

_WINDOW_S = 5.0
#: A tick within so long of a change belongs to neither half (s).
_SETTLING_S = 1.0
_AGAIN_S = 0.1
#: What is promised of the 99th percentiles.
MOST = 1.5


class Lateness(Observer):
    """Sorts the ticks' lateness (ms) by whether there is a crowd."""

    def __init__(self) -> None:
        self.crowd: bool | None = None
        self.found: dict[bool, list[float]] = {False: [], True: []}
        self.missed = {False: 0, True: 0}

    def on_tick(self, record: TickRecord) -> None:
        """Keep a tick."""
        if self.crowd is not None:
            self.found[self.crowd].append(1e3 * record.tick.lateness)
            self.missed[self.crowd] += record.tick.missed


def attack(ports: Sequence[int], count: int) -> None:
    """Hold ``count`` connections open at each port, and trickle into them, for ever."""
    held: dict[socket.socket, int] = {}
    while True:
        for port in ports:
            for _ in range(count - sum(where == port for where in held.values())):
                with contextlib.suppress(OSError):
                    held[socket.create_connection(("127.0.0.1", port), timeout=1.0)] = port
        gone, _, _ = select.select(list(held), [], [], 0.0)
        for each in gone:
            each.close()
            del held[each]
        for each in held:
            with contextlib.suppress(OSError):
                each.sendall(b"G")
        time.sleep(_AGAIN_S)


def measure(seconds: float, connections: int) -> Lateness:
    """Run, with a crowd every other window; return how late the ticks were."""
    plan = _plan(seconds)
    lateness, stop = Lateness(), StopRequest()
    view = LiveView(plan)
    stream = ViewerStream.to_viewers(plan, "127.0.0.1", 0, "--live")
    assert stream.gate is not None
    with WebPage(view, stop, Address("127.0.0.1", 0)) as page, contextlib.closing(stream):
        ports = (page.address.port, stream.gate.address.port)
        over = threading.Event()
        crowd = threading.Thread(target=_come_and_go, args=(lateness, ports, connections, over))
        crowd.start()
        run_session(plan, observers=[view, stream, lateness], stop=stop)
        over.set()
        crowd.join()
    return lateness


def _come_and_go(
    lateness: Lateness, ports: Sequence[int], count: int, over: threading.Event
) -> None:
    names = [str(port) for port in ports]
    while not over.is_set():
        over.wait(_SETTLING_S)
        lateness.crowd = False
        over.wait(_WINDOW_S)
        lateness.crowd = None
        attacker = subprocess.Popen(
            [sys.executable, __file__, "--attack", ",".join(names), "--connections", str(count)]
        )
        over.wait(3.0 * _SETTLING_S)  # it has to be imported, too
        lateness.crowd = True
        over.wait(_WINDOW_S)
        lateness.crowd = None
        attacker.kill()
        attacker.wait()


def _plan(seconds: float) -> Plan:
    settings = (
        *("realtime=true", f"duration_s={seconds}", "approach.enabled=false", "start.y_m=-90"),
        *("start.x_m=0", "start.phi_deg=0", "scheme=pose"),
    )
    overrides = [parse_setting(text) for text in settings]
    return make_plan(load_scenario("mock", overrides, REGISTRIES.backends.names()))


def main() -> int:
    """Measure and print; return 1 if the crowd costs more than is promised."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--connections", type=int, default=500)
    parser.add_argument("--attack", default="", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.attack:
        ports = [int(port) for port in options.attack.split(",")]
        attack(ports, options.connections // len(ports))
    found = measure(options.seconds, options.connections)
    high = {}
    for crowd, name in ((False, "alone"), (True, f"{options.connections} connections")):
        values = np.array(found.found[crowd])
        middle, high[crowd] = np.percentile(values, [50, 99])
        print(
            f"{name:<16} {len(values)} ticks, lateness median {middle:.2f} ms, p99 "
            f"{high[crowd]:.2f} ms, {found.missed[crowd]} missed"
        )
    print(f"ratio of the 99th percentiles: {high[True] / high[False]:.2f}")
    return int(high[True] > MOST * high[False])


if __name__ == "__main__":
    sys.exit(main())
