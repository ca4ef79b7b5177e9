"""Faults of the robot and its line under the driver: standstill in time, and what it says."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

from visctrl.hal.emulator.faults import Channel, Fault, FaultSchedule, parse_fault
from visctrl.hal.emulator.firmware import STEP_S
from visctrl.hal.errors import BaseFaultError, DeviceError, InputError, LinkError
from visctrl.hal.pioneer.commands import Command, Id
from visctrl.hal.types import STANDSTILL, Velocity

MakeBench = Callable[..., Any]
FULL_SPEED = Velocity(0.4, math.radians(20.0))
#: Limits: where the driver can act, and where only the robot's watchdog can (s).
DRIVER_LIMIT_S, WATCHDOG_LIMIT_S = 0.6, 2.1


@dataclass(frozen=True)
class Case:
    """A fault, how soon the robot must stand, and what the driver must say."""

    kind: str
    value: float | None
    limit: float
    error: type[DeviceError]
    says: str


CASES = (
    Case("silent", None, DRIVER_LIMIT_S, LinkError, "not reported"),
    Case("rubbish", None, DRIVER_LIMIT_S, LinkError, "not reported"),
    Case("lost", 1.0, WATCHDOG_LIMIT_S, LinkError, "not reported"),
    Case("corrupt", 1.0, WATCHDOG_LIMIT_S, LinkError, "not reported"),
    Case("delay", 5.0, WATCHDOG_LIMIT_S, LinkError, "not reported"),
    Case("deaf", None, WATCHDOG_LIMIT_S, LinkError, "does not hear"),
    Case("reset", 255, DRIVER_LIMIT_S, LinkError, "restarted"),
    Case("reset", 254, DRIVER_LIMIT_S, LinkError, "restarted"),
    Case("stall", None, DRIVER_LIMIT_S, BaseFaultError, "wheel is stalled"),
    Case("bumper", None, DRIVER_LIMIT_S, BaseFaultError, "front bumper is pressed"),
    Case("estop", None, DRIVER_LIMIT_S, BaseFaultError, "emergency stop is pressed"),
    Case("charging", None, DRIVER_LIMIT_S, BaseFaultError, "take it off the charger"),
    Case("low-battery", 10.5, DRIVER_LIMIT_S, BaseFaultError, "10.5 V"),
)


@pytest.mark.parametrize(("kind", "phase"), [("pty", 0.0), ("tcp", 0.05)])
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.kind}-{case.value}")
def test_fault_at_full_speed(bench: MakeBench, case: Case, kind: str, phase: float) -> None:
    """Whenever in the cycle of reports and commands it begins."""
    it = bench(kind)
    base = it.base()
    base.open()
    it.get_up_to(base, FULL_SPEED)
    it.site.world.sleep(phase)
    it.robot.faults.switch_on(case.kind, case.value)
    began = it.robot.now()
    try:
        with pytest.raises(DeviceError) as caught:
            it.drive(base, FULL_SPEED, 5.0)
    finally:
        base.close()
    assert isinstance(caught.value, case.error)
    assert case.says in str(caught.value)
    it.standstill_after(WATCHDOG_LIMIT_S)
    assert -STEP_S < it.robot.standing_since - began <= case.limit
    it.robot.faults.switch_off(case.kind)
    if case.kind == "delay":
        it.site.world.sleep(case.value)  # the line first delivers what it held back
    it.next_run_works(legal=case.kind not in ("lost", "corrupt"))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("share", [0.02, 0.1, 0.3])
@pytest.mark.parametrize("kind", ["lost", "corrupt"])
def test_line_that_spoils_some_bytes(bench: MakeBench, kind: str, share: float, seed: int) -> None:
    """It stands as soon as its watchdog, fed by chance for the last time, can make it."""
    it = bench(seed=seed)
    base = it.base()
    base.open()
    it.get_up_to(base, FULL_SPEED)
    it.robot.faults.switch_on(kind, share)
    try:
        with contextlib.suppress(DeviceError):  # it gets through, or it does not
            it.drive(base, FULL_SPEED, 3.0)
    finally:
        base.close()
    closed = it.robot.now()
    it.standstill_after(WATCHDOG_LIMIT_S)
    assert it.robot.standing_since - closed <= WATCHDOG_LIMIT_S


def test_robot_left_in_its_session_by_a_broken_line(bench: MakeBench) -> None:
    it = bench()
    base = it.base()
    base.open()
    it.robot.faults.switch_on("lost", 1.0)
    base.close()
    it.site.world.sleep(0.01)
    it.robot.faults.switch_off("lost")
    assert it.robot.motors
    it.next_run_works()


def test_bearable_faults_are_borne(bench: MakeBench) -> None:
    bearable = {"lost": 0.001, "corrupt": 0.001, "delay": 0.06}
    it = bench()
    base = it.base()
    base.open()
    for kind, value in bearable.items():
        it.robot.faults.switch_on(kind, value)
    try:
        it.drive(base, Velocity(0.3, 0.3), 2.0)
        it.drive(base, STANDSTILL, 1.5)
    finally:
        base.close()
    odometry, truth = base.odometry().pose, it.robot.pose
    assert math.dist(odometry[:2], truth[:2]) < 0.01


def test_reports_pause_for_a_moment(bench: MakeBench) -> None:
    """The robot is braked when it has been blind for long enough, and goes on afterwards."""
    it = bench()
    base = it.base()
    base.open()
    try:
        it.drive(base, FULL_SPEED, 1.2)
        it.robot.faults.switch_on("silent")
        while Command(Id.E_STOP) not in it.robot.traffic.commands():
            sent = base.command(FULL_SPEED)
            it.site.world.sleep(0.02)
        it.robot.faults.switch_off("silent")
        assert base.command(FULL_SPEED) == STANDSTILL  # and it says so
        assert sent == FULL_SPEED
        assert it.drive(base, FULL_SPEED, 1.0) == FULL_SPEED
        assert it.robot.velocity.v > 0.1
    finally:
        base.close()


def test_fault_holds_the_robot_until_it_is_over(bench: MakeBench) -> None:
    it = bench()
    base = it.base()
    base.open()
    try:
        base.command(FULL_SPEED)
        it.robot.faults.switch_on("bumper")
        it.site.world.sleep(0.25)
        assert base.command(FULL_SPEED) == STANDSTILL
        it.robot.faults.switch_off("bumper")
        it.site.world.sleep(0.25)
        assert base.command(FULL_SPEED) == FULL_SPEED
    finally:
        base.close()


@pytest.mark.parametrize(("kind", "says"), [("estop", "emergency stop"), ("charging", "charger")])
def test_motors_that_cannot_be_enabled(bench: MakeBench, kind: str, says: str) -> None:
    it = bench()
    it.robot.faults.switch_on(kind)
    base = it.base()
    with pytest.raises(BaseFaultError, match=says):
        base.open()
    base.close()
    assert not it.robot.motors


def test_robot_is_switched_off(bench: MakeBench) -> None:
    it = bench("tcp")
    base = it.base()
    base.open()
    base.command(FULL_SPEED)
    it.robot.close()
    try:
        with pytest.raises(LinkError, match="hung up"):
            it.drive(base, FULL_SPEED, 1.0)
        assert "hung up" in base.status().faults[0]
    finally:
        base.close()


# --- the schedule ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("silent", Fault("silent")),
        ("silent@3", Fault("silent", None, 3.0)),
        ("lost=0.5@1.5+2", Fault("lost", 0.5, 1.5, 2.0)),
        ("low-battery@1", Fault("low-battery", 10.5, 1.0)),
    ],
)
def test_fault_is_read(text: str, fault: Fault) -> None:
    assert parse_fault(text) == fault


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("stal", "did you mean 'stall'"),
        ("stall=3", "takes no value"),
        ("stall@x", "expected KIND"),
        ("lost=1.2.3", "cannot be read"),
    ],
)
def test_fault_is_not_read(text: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        parse_fault(text)


def test_schedule_counts_from_the_first_motion() -> None:
    schedule = FaultSchedule([Fault("silent", None, 2.0, 1.0), Fault("lost", 0.1)])
    for since, active in ((None, False), (0.0, False), (2.0, True), (2.9, True), (3.0, False)):
        schedule.update(since)
        assert ("silent" in schedule) is active
        assert schedule.value("lost") == 0.1


def test_channel_delays_and_loses() -> None:
    schedule = FaultSchedule()
    channel = Channel(schedule, seed=1)
    channel.put(0.0, b"now")
    assert channel.take(0.0) == b"now"
    schedule.switch_on("delay", 0.5)
    channel.put(1.0, b"later")
    assert channel.take(1.4) == b""
    assert channel.take(1.5) == b"later"
    schedule.switch_off("delay")
    schedule.switch_on("lost", 0.25)
    channel.put(2.0, bytes(10_000))
    assert 7_000 < len(channel.take(2.0)) < 8_000
    schedule.switch_off("lost")
    schedule.switch_on("corrupt", 0.25)
    channel.put(3.0, bytes(10_000))
    damaged = channel.take(3.0)
    assert len(damaged) == 10_000
    assert 2_000 < sum(byte != 0 for byte in damaged) < 3_000
