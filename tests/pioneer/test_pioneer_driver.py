"""The driver against the emulator, on simulated time."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pioneer_bench import Bench
from virtual_robot import Site, renamed_robot

from visctrl.hal.clock import ManualClock, WallClock
from visctrl.hal.emulator.firmware_profile import ARCOS, SIMULATOR, Personality
from visctrl.hal.errors import DeviceError, InputError, LinkError
from visctrl.hal.pioneer.base import PioneerBase
from visctrl.hal.pioneer.commands import FORBIDDEN, Command, Id
from visctrl.hal.pioneer.link import SPACING_S, Link
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.robots import load_robot

MakeBench = Callable[..., Any]


@pytest.mark.parametrize(("kind", "personality"), [("pty", ARCOS), ("tcp", SIMULATOR)])
def test_session(bench: MakeBench, kind: str, personality: Personality) -> None:
    it = bench(kind, personality=personality)
    base = it.base()
    base.open()
    assert it.robot.motors
    assert base.status().faults == ()
    assert base.status().battery_v == pytest.approx(12.8)
    sent = it.drive(base, Velocity(0.3, math.radians(-20)), 1.5)
    assert sent == (0.3, math.radians(-20))
    velocity = it.robot.velocity
    assert velocity.v == pytest.approx(0.3)
    assert velocity.omega == pytest.approx(math.radians(-20))
    it.site.wait_until(lambda: len(base.echoes()) == 16, 0.5)
    assert set(base.echoes().values()) == {5.0}
    assert [reading.distance for reading in base.ranges()] == [math.inf] * 16
    base.close()
    base.close()
    odometry, truth = base.odometry().pose, it.robot.pose
    assert math.dist(odometry[:2], truth[:2]) < 0.01
    assert odometry.phi == pytest.approx(truth.phi, abs=math.radians(0.6))
    assert it.robot.velocity == STANDSTILL
    assert not it.robot.motors
    assert it.robot.traffic.violations() == []
    with pytest.raises(LinkError, match="not connected"):
        base.command(Velocity(0.1, 0.0))


def test_signs_and_whole_units(bench: MakeBench) -> None:
    it = bench(subclass="p3at-sh")
    base = it.base("p3at")
    base.open()
    try:
        sent = base.command(Velocity(-0.12345, 0.3))
        assert sent == (-0.123, math.radians(17))
        limits = load_robot("p3at").operating
        clipped = base.command(Velocity(10.0 * limits.v_m_s, limits.omega_rad_s))
        assert clipped.v == limits.v_m_s
        assert clipped.omega == pytest.approx(limits.omega_rad_s / 10.0, abs=math.radians(0.5))
        with pytest.raises(ValueError, match="finite"):
            base.command(Velocity(math.nan, 0.0))
    finally:
        base.close()
    commands = [str(command) for command in it.robot.traffic.commands()]
    assert "VEL -123" in commands
    assert "RVEL 17" in commands


def test_robot_left_open_and_moving_is_stopped_first(bench: MakeBench) -> None:
    it = bench()
    client = it.site.line(it.robot).connect(timeout=0.2, exclusive=True)
    session = [Command(number) for number in (Id.PULSE, Id.OPEN, Id.CLOSE, Id.OPEN)]
    for command in (*session, Command(Id.ENABLE, 1), Command(Id.VEL, 400)):
        client.write(command.encode())
        it.site.world.sleep(0.01)
    it.site.world.sleep(0.7)
    client.close()
    before = len(it.robot.traffic.commands())
    assert it.robot.velocity.v > 0.1
    base = it.base()
    base.open()
    try:
        assert it.robot.traffic.commands()[before] == Command(Id.CLOSE)
        assert it.robot.velocity == STANDSTILL
    finally:
        base.close()


def test_nobody_commands_a_moving_robot(bench: MakeBench) -> None:
    it = bench()
    base = it.base()
    base.open()
    try:
        it.get_up_to(base, Velocity(0.4, 0.5))
        assert it.standstill_after(0.6) > 0.2
        it.site.world.sleep(2.3)  # longer than the watchdog: the driver feeds it, the robot stands
        assert it.robot.velocity == STANDSTILL
        it.drive(base, Velocity(0.2, 0.0), 0.5)
        assert it.robot.velocity.v > 0.05
    finally:
        base.close()
    assert it.robot.traffic.violations() == []


def program(it: Any) -> None:
    """Drive at full speed for ever."""
    base = it.base()
    base.open()
    while True:
        base.command(Velocity(0.4, 0.0))
        it.site.world.sleep(0.1)


def test_killed_program(bench: MakeBench) -> None:
    """Nothing of it feeds the watchdog afterwards; the next one takes the robot over."""
    it = bench()
    it.site.world.start(lambda: program(it), "driver")
    it.site.at_speed(it.robot, Velocity(0.4, 0.0))
    it.site.world.kill("driver")
    killed = it.robot.now()
    it.standstill_after(2.1)
    assert it.robot.traffic.entries[-1].latest < killed + 0.01
    it.site.line(it.robot).open = False  # the system closes what a dead process had open
    it.next_run_works()


@pytest.mark.parametrize("notices", [True, False])
def test_killed_program_on_a_serial_device_server(site: Site, notices: bool) -> None:
    """The server tells the robot nothing: its watchdog acts. Only the simulator notices."""
    it = Bench(site, site.robot("socket://robot:8101", notices_hang_up=notices))
    it.site.world.start(lambda: program(it), "driver")
    it.site.at_speed(it.robot, Velocity(0.4, 0.0))
    it.site.world.kill("driver")
    it.site.line(it.robot).open, it.site.line(it.robot).client_lost = False, True
    stood = it.standstill_after(2.5)
    assert stood < 0.6 if notices else 1.9 < stood < 2.5
    it.next_run_works()


@pytest.mark.parametrize("pause", [1.5, 3.0])
@pytest.mark.parametrize("within", [False, True])
def test_frozen_program_does_not_revive_the_robot(
    bench: MakeBench, pause: float, within: bool
) -> None:
    """After a pause the set-points are taken back first, even if it fell between the two."""
    it = bench()
    it.site.world.start(lambda: program(it), "driver")
    it.site.at_speed(it.robot, Velocity(0.4, 0.0))
    last = Id.VEL if within else Id.RVEL
    it.site.wait_until(lambda: it.robot.traffic.commands()[-1].id == last)
    it.site.world.freeze("driver")
    it.site.world.sleep(pause)
    before = len(it.robot.traffic.commands())
    it.site.world.thaw("driver")
    it.site.wait_until(lambda: len(it.robot.traffic.commands()) > before + 3)
    new = [str(command) for command in it.robot.traffic.commands()[before : before + 4]]
    assert new == ["VEL 0", "RVEL 0", "VEL 400", "RVEL 0"]
    assert it.robot.traffic.violations() == []


# --- ports and robots that will not do -----------------------------------------------


def open_error(url: str, kind: type[Exception] = LinkError) -> str:
    base = PioneerBase(url, load_robot("p3dx"), load_robot("p3dx").operating, WallClock(), (9600,))
    with pytest.raises(kind) as caught:
        base.open()
    base.close()
    return str(caught.value)


def test_busy_port(bench: MakeBench) -> None:
    it = bench()
    base = it.base()
    base.open()
    try:
        assert "in use" in open_error(it.robot.url)
    finally:
        base.close()


def test_no_such_port(site: Site) -> None:
    assert "no such port" in open_error("/dev/does-not-exist")


def test_rubbish(bench: MakeBench) -> None:
    it = bench()
    it.robot.faults.switch_on("rubbish")
    assert "noise" in open_error(it.robot.url)


def test_another_robot_than_expected(bench: MakeBench) -> None:
    it = bench(subclass="p3at-sh")
    assert "--robot p3at" in open_error(it.robot.url, InputError)
    assert not it.robot.motors


def test_unknown_subclass(bench: MakeBench, tmp_path: Path) -> None:
    it = bench(subclass=str(renamed_robot(tmp_path, "seekur")))
    message = open_error(it.robot.url)
    assert "'seekur'" in message
    assert "known: " in message
    assert "p2at" in message
    assert not it.robot.motors
    assert it.robot.traffic.commands()[-1] == Command(Id.CLOSE)


# --- what is sent ----------------------------------------------------------------------------


def test_controller_is_never_reset(bench: MakeBench) -> None:
    """Of everything that the driver sends in a session full of trouble."""
    it = bench()
    base = it.base()
    base.open()
    for kind in ("bumper", "silent", "estop"):
        it.robot.faults.switch_on(kind)
        with contextlib.suppress(DeviceError):
            it.drive(base, Velocity(0.4, 0.5), 0.3)
        it.robot.faults.switch_off(kind)
        it.site.world.sleep(0.2)
    base.close()
    entries = it.robot.traffic.entries
    assert len(entries) > 30
    assert not {entry.packet.id for entry in entries} & FORBIDDEN
    assert it.robot.traffic.violations() == []
    spacing = [b.latest - a.latest for a, b in itertools.pairwise(entries)]
    assert min(spacing) > 0.005


def test_commands_keep_their_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = ManualClock()
    link = Link("loop://", clock)
    link.open()
    times: list[float] = []
    port = link._port
    assert port is not None
    monkeypatch.setattr(port, "write", lambda data: times.append(clock.now()))
    link.send(*(Command(Id.PULSE) for _ in range(5)))
    clock.advance(1.0)
    link.send(Command(Id.PULSE), Command(Id.PULSE))
    gaps = [b - a for a, b in itertools.pairwise(times)]
    assert gaps == pytest.approx([SPACING_S] * 4 + [1.0] + [SPACING_S])
    link.close()
