"""Other makers' clients on the emulator: what they were recorded to send, answered as they need.

The recordings hold whole sessions of two clients with peers that they accept. Their bytes are
sent to the emulator's port at the recorded times. Of a third client single packets are known.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from virtual_robot import Client, Site

from visctrl.hal.emulator.emulator import Emulator
from visctrl.hal.pioneer.commands import Command, Id
from visctrl.hal.pioneer.config import Config, decode_config
from visctrl.hal.pioneer.packet import Packet, StreamDecoder
from visctrl.hal.pioneer.reports import (
    StandardReport,
    Type,
    decode_identity,
    decode_standard_report,
    is_standard_report,
)
from visctrl.hal.pioneer.subclasses import HEADING_RAD, known_subclasses
from visctrl.hal.types import STANDSTILL
from visctrl.robots.unicycle import wrap_angle

DATA = Path(__file__).parents[1] / "data" / "arcos"
#: Parameters by which a client knows the robot, and those that it takes its limits from.
SAME = ("robot_type", "subclass", "watchdog", "report_cycle")
LIMITS = (
    "turn_max", "speed_max", "turn_acceleration", "turn_deceleration", "acceleration",
    "deceleration",
)  # fmt: skip


def packets_of(lines: Iterable[dict[str, Any]], direction: str) -> list[Packet]:
    wire = b"".join(bytes.fromhex(line["hex"]) for line in lines if line["dir"] == direction)
    return StreamDecoder().feed(wire)


def reports_in(packets: Iterable[Packet]) -> list[StandardReport]:
    return [decode_standard_report(packet) for packet in packets if is_standard_report(packet)]


class Peer:
    """A client's end of the emulator's line."""

    def __init__(self, site: Site, url: str = "/dev/robot") -> None:
        self.site = site
        self.robot: Emulator = site.robot(url)
        self.client: Client = site.line(self.robot).connect(timeout=0.0, exclusive=True)
        self.heard: list[Packet] = []
        self._decoder = StreamDecoder()

    def send(self, data: bytes, wait: float = 0.01) -> list[Packet]:
        """Send bytes; return what has come until a little later."""
        self.client.write(data)
        return self.wait(wait)

    def wait(self, seconds: float) -> list[Packet]:
        self.site.world.sleep(seconds)
        new = self._decoder.feed(self.client.read(4096), self.site.world.now)
        self.heard += new
        return new

    def reports(self) -> list[StandardReport]:
        return reports_in(self.heard)


@pytest.mark.parametrize("session", ["aria", "soar"])
def test_recorded_client(site: Site, session: str) -> None:
    """Every answer comes that its own peer gave, and the robot ends where that one ended."""
    lines = [
        json.loads(line) for line in (DATA / f"{session}_session.jsonl").read_text().splitlines()
    ]
    peer = Peer(site)
    if session == "aria":
        assert peer.send(b"WMS2\r") == []  # what it wakes a radio modem with, on serial lines
    offset = site.world.now - lines[0]["t"]
    for line in lines:
        if line["dir"] == "c2s":
            peer.wait(max(0.0, line["t"] + offset - site.world.now))
            peer.client.write(bytes.fromhex(line["hex"]))
    peer.wait(0.5)
    theirs, mine = packets_of(lines, "s2c"), peer.heard

    def answers(packets: list[Packet]) -> list[int]:
        return [packet.id for packet in packets if not is_standard_report(packet)]

    assert [i for i in answers(mine) if i != Type.IO] == [
        i for i in answers(theirs) if i != Type.IO
    ]
    assert abs(answers(mine).count(Type.IO) - answers(theirs).count(Type.IO)) <= 1  # streamed
    assert mine[:2] == theirs[:2] == [Packet(0), Packet(1)]
    assert decode_identity(mine[2]).subclass == decode_identity(theirs[2]).subclass
    same_configuration(config_of(mine), config_of(theirs))
    same_reports(
        peer.reports(), [decode_standard_report(p) for p in theirs if is_standard_report(p)]
    )
    assert peer.robot.velocity == STANDSTILL


def config_of(packets: list[Packet]) -> Config:
    return decode_config(next(packet for packet in packets if packet.id == Type.CONFIG))


def same_configuration(mine: Config, theirs: Config) -> None:
    assert mine.subclass in known_subclasses()
    for name in SAME:
        assert getattr(mine, name) == getattr(theirs, name), name
    for name in LIMITS:
        assert getattr(mine, name) > 0, name


def same_reports(mine: list[StandardReport], theirs: list[StandardReport]) -> None:
    """As many, about as many of them in motion, of the same form, to the same place."""
    assert abs(len(mine) - len(theirs)) <= 2
    moving = [sum(report.moving for report in reports) for reports in (mine, theirs)]
    assert abs(moving[0] - moving[1]) <= 0.05 * len(theirs)
    for report in mine:
        assert len(report.sonar) == report.motion.sonar_count <= 16
        assert report.tail.turn_rate is not None
        assert report.tail.surplus == b""
    last, reference = mine[-1].motion, theirs[-1].motion
    for name in ("x", "y"):
        step = (getattr(last, name) - getattr(reference, name) + 0x8000) % 0x10000 - 0x8000
        assert abs(step) <= 30  # mm; the ramps need not be the same
    turned = (last.theta - reference.theta) * HEADING_RAD
    assert abs(math.degrees(float(wrap_angle(turned)))) < 1.5


def test_client_that_sends_wheel_speeds(site: Site) -> None:
    """Player's driver: in its order, with the packets that are known of it byte for byte."""
    peer = Peer(site, "socket://robot:8101")
    recorded = {
        vector["what"]: bytes.fromhex(vector["hex"])
        for vector in json.loads((DATA / "golden_vectors.json").read_text())
        if vector["source"].startswith("Player")
    }
    for number in (Id.PULSE, Id.OPEN, Id.CLOSE):
        assert [packet.id for packet in peer.send(Command(number).encode(), 0.05)] == [number]
    peer.send(Command(Id.OPEN).encode(), 0.2)
    peer.send(Command(Id.PULSE).encode(), 0.2)
    setup = [Command(Id.SONAR, 0), Command(Id.BUMPSTALL, 0), Command(Id.SONAR, 1)]
    for data in (*(command.encode() for command in setup), recorded["SETA 400"],
                 recorded["SETA -500"], Command(Id.ENABLE, 0).encode(), recorded["SETO 0"],
                 Command(Id.ENABLE, 1).encode()):  # fmt: skip
        # It reads one packet for each that it sends, and hangs if none comes.
        assert peer.send(data, 0.11)
    for what, left, right in (
        ("VEL2 2570", 200, 200),
        ("VEL2 63993", -140, -140),
        ("VEL2 64516", -80, 80),
        ("VEL2 2049", 160, 20),
        ("VEL2 0", 0, 0),
    ):
        for _ in range(12):
            peer.send(recorded[what], 0.25)
        motion = peer.reports()[-1].motion
        assert (motion.left, motion.right) == (
            pytest.approx(left, abs=1),
            pytest.approx(right, abs=1),
        )
    peer.send(recorded["VEL 100"], 0.5)
    assert peer.robot.velocity.v > 0.05
    peer.client.close()  # it drops the line without a word
    site.wait_until(lambda: peer.robot.velocity == STANDSTILL, 2.1 + 0.5)
    assert not any("legal" in each or "encoded" in each for each in peer.robot.traffic.violations())
