"""Lines that damage, lines that are slow, lines that are full, and robots that report otherwise."""

from __future__ import annotations

import logging
import math
import random
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from visctrl.hal.errors import DeviceError, LinkError
from visctrl.hal.pioneer.commands import Id
from visctrl.hal.pioneer.timing import LineLoad, Timing
from visctrl.hal.types import STANDSTILL, Velocity

MakeBench = Callable[..., Any]
OPENINGS = 25


def damage(share: float, seed: int) -> Callable[[bytes], bytes]:
    """Return what flips a bit in a share of the packets that are written."""
    chance = random.Random(f"{seed} {share}")

    def spoil(data: bytes) -> bytes:
        if chance.random() >= share:
            return data
        at = chance.randrange(len(data))
        return data[:at] + bytes([data[at] ^ (1 << chance.randrange(8))]) + data[at + 1 :]

    return spoil


def opens(it: Any) -> bool:
    """Return whether a session opens, and leave it in order."""
    base = it.base()
    try:
        base.open()
    except DeviceError:
        return False
    finally:
        base.close()
    return True


@pytest.mark.parametrize("kind", ["pty", "socket"])
@pytest.mark.parametrize("share", [0.05, 0.15])
def test_sessions_open_on_a_line_that_damages_commands(
    bench: MakeBench, kind: str, share: float
) -> None:
    opened = 0
    for seed in range(OPENINGS):
        it = bench(kind, seed=seed)
        it.site.line(it.robot).spoil = damage(share, seed)
        opened += opens(it)
        it.site.line(it.robot).spoil = bytes
        it.site.world.sleep(2.5)
        assert it.robot.velocity == STANDSTILL
        it.robot.close()
    assert opened >= OPENINGS - 1


def test_sessions_open_on_a_line_that_damages_bytes_in_both_directions(bench: MakeBench) -> None:
    """One byte in a hundred: every twelfth command, and every second report."""
    opened = 0
    for seed in range(OPENINGS):
        it = bench(seed=seed)
        it.robot.faults.switch_on("corrupt", 0.01)
        opened += opens(it)
        it.robot.close()
    assert opened >= OPENINGS - 1


@pytest.mark.parametrize("kind", ["pty", "socket"])
@pytest.mark.parametrize("round_trip", [0.4, 1.0])
def test_slow_lines_are_told_and_borne(
    bench: MakeBench, caplog: pytest.LogCaptureFixture, kind: str, round_trip: float
) -> None:
    it = bench(kind)
    it.robot.faults.switch_on("delay", round_trip / 2)
    base = it.base()
    with caplog.at_level(logging.WARNING):
        base.open()
    try:
        assert "the line to the robot is slow" in caplog.text
        assert base.round_trip_s == pytest.approx(round_trip, abs=0.05)
        it.drive(base, Velocity(0.2, 0.0), 3.0)
        assert it.robot.velocity.v == pytest.approx(0.2)
    finally:
        base.close()
    it.standstill_after(2.1)


def test_a_quick_line_is_not_called_slow(
    bench: MakeBench, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        assert opens(bench())
    assert "slow" not in caplog.text


@pytest.mark.parametrize("cycle_ms", [20, 50, 200, 255])
def test_reports_of_another_cycle_do_not_brake_the_robot(bench: MakeBench, cycle_ms: int) -> None:
    it = bench()
    firmware = it.robot._firmware
    config = replace(firmware.profile.config, report_cycle=cycle_ms)
    firmware.profile = replace(firmware.profile, config=config)
    base = it.base()
    base.open()
    try:
        it.get_up_to(base, Velocity(0.4, 0.0))
        it.drive(base, Velocity(0.4, 0.0), 2.0)
        sent = [command.id for command in it.robot.traffic.commands()]
        assert Id.E_STOP not in sent
        it.robot.faults.switch_on("silent")
        began = it.robot.now()
        with pytest.raises(LinkError, match="has not reported"):
            it.drive(base, Velocity(0.4, 0.0), 5.0)
    finally:
        base.close()
    it.standstill_after(1.0)
    # Up to a cycle passes before the first report is missed at all.
    assert it.robot.standing_since - began < max(0.6, 2.6 * cycle_ms / 1e3 + 0.2)


@given(st.integers(1, 255), st.floats(0.0, 1.0))
def test_limits_follow_from_cycle_and_round_trip(cycle_ms: int, round_trip: float) -> None:
    timing = Timing.of(cycle_ms, round_trip)
    assert cycle_ms / 1e3 < timing.blind_s < timing.silent_s
    assert timing.disobedient_s >= 1.5
    usual = Timing.of(None, 0.0)
    assert (usual.blind_s, usual.silent_s) == (0.35, 0.5)
    assert timing.blind_s <= usual.blind_s or cycle_ms > 100


def test_what_a_line_can_carry(bench: MakeBench, caplog: pytest.LogCaptureFixture) -> None:
    """An 89-byte report at 9600 baud takes 93 ms of 100."""
    full = LineLoad(9600, 89, 0.1)
    assert full.share == pytest.approx(0.927, abs=1e-3)
    assert full.heavy
    assert "takes 93 ms of a cycle of 100 ms: the line is full" in str(full)
    assert not LineLoad(38400, 89, 0.1).heavy
    it = bench()
    base = it.base()
    with caplog.at_level(logging.WARNING):
        base.open()
    base.close()
    assert base.line_load.baud == 9600
    assert math.isclose(base.line_load.share, base.line_load.report_bytes / 96.0)
    assert ("the line is full" in caplog.text) is base.line_load.heavy
    over_tcp = bench("socket")
    base = over_tcp.base()
    base.open()
    base.close()
    assert base.line_load is None


def full_line(it: Any, auto_baud: int = 2, cycle_ms: int = 40) -> Any:
    """Let the robot's end have a rate, and reports that fill it."""
    firmware = it.robot._firmware
    config = replace(firmware.profile.config, auto_baud=auto_baud, report_cycle=cycle_ms)
    firmware.profile = replace(firmware.profile, config=config)
    line = it.site.line(it.robot)
    line.baud = 9600
    return line


@pytest.mark.parametrize(("cycle_ms", "rate"), [(40, 19200), (20, 38400), (10, 115200)])
def test_a_full_line_is_made_as_fast_as_it_must_be(
    bench: MakeBench, cycle_ms: int, rate: int
) -> None:
    it = bench()
    line = full_line(it, cycle_ms=cycle_ms)
    base = it.base()
    base.open()
    try:
        assert (line.baud, line.client_baud) == (rate, rate)
        it.get_up_to(base, Velocity(0.4, 0.0))
    finally:
        base.close()
    assert (line.baud, line.client_baud) == (9600, 9600), "left as it was found"
    it.standstill_after(0.2)
    it.next_run_works()


@pytest.mark.parametrize("too_fast", [False, True])
def test_a_full_line_that_cannot_be_faster(
    bench: MakeBench, caplog: pytest.LogCaptureFixture, too_fast: bool
) -> None:
    """Because the robot's parameter forbids it, or because the line does not pass more."""
    it = bench()
    line = full_line(it, auto_baud=2 if too_fast else 0)
    line.too_fast = frozenset({19200} if too_fast else ())
    base = it.base()
    with caplog.at_level(logging.WARNING):
        base.open()
    base.close()
    assert line.baud == 9600
    assert "the line is full" in caplog.text


# --- reconnecting within a run ---------------------------------------------------------------


def told(it: Any, base: Any, seconds: float) -> list[Velocity]:
    """Command full speed at 10 Hz; return what was sent each time."""
    sent = []
    for _ in range(round(10 * seconds)):
        sent.append(base.command(Velocity(0.4, 0.0)))
        assert base.status().faults == ()
        it.site.world.sleep(0.1)
    return sent


@pytest.mark.parametrize("kind", ["silent", "reset", "lost", "hung up"])
def test_a_line_that_comes_back_within_a_run(bench: MakeBench, kind: str) -> None:
    it = bench("socket" if kind == "hung up" else "pty")
    line = it.site.line(it.robot)
    base = it.base(reconnect_s=10.0)
    base.open()
    try:
        it.get_up_to(base, Velocity(0.4, 0.0))
        before = base.odometry().pose
        if kind == "hung up":
            line.hung_up = True
        else:
            it.robot.faults.switch_on(kind, 1.0 if kind == "lost" else None)
        began = it.robot.now()
        away = told(it, base, 2.5)
        assert STANDSTILL in away
        if kind != "reset":  # after which a new session begins at once
            assert away[-1] == STANDSTILL
            assert it.robot.velocity == STANDSTILL
            only_the_watchdog_can_act = kind in ("lost", "hung up")
            assert it.robot.standing_since - began < (2.7 if only_the_watchdog_can_act else 0.6)
        if kind == "hung up":
            line.hung_up = False
        else:
            it.robot.faults.switch_off(kind)
        told(it, base, 7.0)
        assert it.robot.velocity.v == pytest.approx(0.4), "it goes on"
        truth, pose = it.robot.pose, base.odometry().pose
        assert pose.y > before.y + 0.4
        # A report is up to 0.1 s old, at 0.4 m/s. After a restart, what the robot rolled between
        # its last report and its standstill is missing as well.
        assert abs(pose.y - truth.y) < (0.15 if kind == "reset" else 0.05)
    finally:
        base.close()
    it.standstill_after(0.2)
    assert not it.robot.motors


@pytest.mark.parametrize("closes", [False, True])
def test_a_line_that_stays_away(bench: MakeBench, closes: bool) -> None:
    """The drive ends with the first failure; closing meanwhile does not wait for an attempt."""
    it = bench()
    base = it.base(reconnect_s=3.0)
    base.open()
    it.get_up_to(base, Velocity(0.4, 0.0))
    it.robot.faults.switch_on("lost", 1.0)
    try:
        if closes:
            told(it, base, 1.5)
        else:
            with pytest.raises(LinkError, match="has not reported"):
                told(it, base, 30.0)
    finally:
        began = it.site.world.now
        base.close()
    assert it.site.world.now - began < 1.0
    it.robot.faults.switch_off("lost")
    it.site.world.sleep(2.5)
    it.next_run_works(legal=False)


def test_without_being_asked_nothing_is_opened_anew(bench: MakeBench) -> None:
    it = bench()
    base = it.base()
    base.open()
    it.get_up_to(base, Velocity(0.4, 0.0))
    it.robot.faults.switch_on("silent")
    try:
        with pytest.raises(LinkError, match="has not reported"):
            told(it, base, 2.0)
    finally:
        base.close()
