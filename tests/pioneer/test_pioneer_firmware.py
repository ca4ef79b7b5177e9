"""The emulated firmware, on a clock moved by hand: sessions, motion, reports, habits."""

from __future__ import annotations

import math

import pytest

from visctrl.hal.emulator.firmware import Firmware
from visctrl.hal.emulator.firmware_profile import ARCOS, SIMULATOR, Personality, emulated, profile
from visctrl.hal.emulator.world import Room
from visctrl.hal.pioneer.commands import Command, Id
from visctrl.hal.pioneer.config import decode_config
from visctrl.hal.pioneer.packet import Packet, StreamDecoder
from visctrl.hal.pioneer.reports import (
    Flags,
    StandardReport,
    decode_encoders,
    decode_identity,
    decode_inputs,
    decode_standard_report,
    is_standard_report,
)
from visctrl.hal.pioneer.subclasses import HEADING_RAD, known_subclasses
from visctrl.hal.pioneer.telemetry import Telemetry
from visctrl.hal.types import Pose, Velocity
from visctrl.robots.unicycle import wrap_angle


class Client:
    """Talks to a firmware at chosen instants and keeps all that comes back."""

    def __init__(self, firmware: Firmware) -> None:
        self.firmware = firmware
        self.t = 0.0
        self.packets: list[Packet] = []
        self._hearing, self._talking = StreamDecoder(), StreamDecoder()

    def send(self, *commands: Command) -> list[Packet]:
        return self.send_bytes(b"".join(command.encode() for command in commands))

    def send_bytes(self, data: bytes) -> list[Packet]:
        replies = []
        for packet in self._talking.feed(data):
            for reply in self.firmware.receive(packet):
                replies += self._hearing.feed(reply, self.t)
        self.packets += replies
        return replies

    def wait(self, seconds: float, *, pulse: bool = True) -> list[StandardReport]:
        """Let time pass, feeding the watchdog; return the reports."""
        reports = []
        for _ in range(round(seconds / 0.1)):
            if pulse:
                self.send(Command(Id.PULSE))
            reports += self.until(self.t + 0.1)
        return reports

    def until(self, t: float) -> list[StandardReport]:
        self.t = round(t, 4)
        new = [p for data in self.firmware.advance(t) for p in self._hearing.feed(data, t)]
        self.packets += new
        return [decode_standard_report(packet) for packet in new if is_standard_report(packet)]

    def connect(self) -> None:
        for number in (Id.PULSE, Id.OPEN, Id.CLOSE):
            assert self.send(Command(number))[0].id == number
        self.send(Command(Id.OPEN))

    def drive(self, *commands: Command) -> None:
        """Connect, enable the motors and send commands."""
        self.connect()
        self.send(Command(Id.ENABLE, 1), *commands)


def client(subclass: str = "p3dx-sh", personality: Personality = ARCOS) -> Client:
    return Client(Firmware(profile(emulated(subclass), personality)))


# --- sessions ------------------------------------------------------------------------------


@pytest.mark.parametrize("subclass", sorted(known_subclasses()))
def test_handshake_and_configuration(subclass: str) -> None:
    it = client(subclass)
    assert it.send(Command(Id.PULSE)) == [Packet(0)]
    assert it.send(Command(Id.OPEN)) == [Packet(1)]
    assert decode_identity(it.send(Command(Id.CLOSE))[0]).subclass == subclass
    assert it.wait(0.5, pulse=False) == []  # no reports before OPEN
    it.send(Command(Id.OPEN))
    config = decode_config(it.send(Command(Id.CONFIG, 1))[0])
    assert (config.subclass, config.watchdog) == (subclass, 2000)
    assert len(it.wait(1.0)) == 10


def test_sync_out_of_order_starts_over() -> None:
    it = client()
    it.send(Command(Id.PULSE))
    assert it.send(Command(Id.CLOSE)) == []
    assert it.send(Command(Id.OPEN)) == []
    it.connect()
    assert it.wait(0.3)


def test_modem_wake_up_and_other_junk_before_the_handshake() -> None:
    it = client()
    assert it.send_bytes(b"WMS2\r\xfa\xfa") == []
    it.connect()
    assert it.wait(0.3)


def test_arguments_where_none_belong_and_the_reverse() -> None:
    it = client()
    for number in (Id.PULSE, Id.OPEN, Id.CLOSE):
        it.send(Command(number))
    it.send(Command(Id.OPEN, 1))
    it.wait(0.2)
    assert it.send(Command(Id.CONFIG, 1))
    assert it.send(Command(Id.CONFIG))
    it.send_bytes(bytes.fromhex("fafb04073b073b"))  # SETO, its value missing
    it.send(Command(Id.BATTERYINFO, 1), Command(200, 5))
    assert it.wait(0.2)
    it.send(Command(Id.CLOSE, 1))
    assert it.wait(0.5, pulse=False) == []


def test_close_ends_reports_motion_and_settings() -> None:
    it = client()
    it.drive(Command(Id.SETV, 500), Command(Id.VEL, 400))
    it.wait(2.0)
    it.send(Command(Id.CLOSE))
    assert it.wait(0.5, pulse=False) == []
    assert it.firmware.drive.standing
    assert it.firmware.drive.translation.speed == pytest.approx(1.2)
    it.connect()
    assert not it.wait(0.2)[-1].motion.flags & Flags.MOTORS


def test_restart_says_so_and_forgets_the_session() -> None:
    it = client()
    it.drive(Command(Id.VEL, 400))
    it.wait(1.0)
    assert it.firmware.restart() == [Packet(0xFF).encode()]
    assert it.wait(0.5, pulse=False) == []
    assert it.firmware.drive.standing


@pytest.mark.parametrize(("personality", "enabled"), [(ARCOS, False), (SIMULATOR, True)])
def test_motors_at_connection(personality: Personality, enabled: bool) -> None:
    it = client(personality=personality)
    it.connect()
    it.send(Command(Id.VEL, 300))
    last = it.wait(1.0)[-1]
    assert bool(last.motion.flags & Flags.MOTORS) is enabled
    assert (last.motion.left > 0) is enabled


# --- motion ----------------------------------------------------------------------------------


def test_ramps_and_limits() -> None:
    it = client()
    it.drive(Command(Id.SETV, 500), Command(Id.SETA, 250), Command(Id.SETA, -500))
    it.send(Command(Id.VEL, 900))
    it.wait(1.0)
    assert it.firmware.drive.velocity.v == pytest.approx(0.25, abs=0.002)
    it.wait(2.0)
    assert it.firmware.drive.velocity.v == pytest.approx(0.5)
    it.send(Command(Id.STOP))
    it.wait(0.5)
    assert it.firmware.drive.velocity.v == pytest.approx(0.25, abs=0.003)
    it.wait(0.6)
    assert it.firmware.drive.standing
    assert it.firmware.motors


def test_settings_stay_below_the_controllers_own() -> None:
    it = client("p3at-sh")
    it.drive(Command(Id.SETV, 5000), Command(Id.SETRV, 2000), Command(Id.SETA, 9000))
    assert it.firmware.drive.translation.speed == pytest.approx(1.2)
    assert it.firmware.drive.rotation.speed == pytest.approx(math.radians(300))
    assert it.firmware.drive.translation.acceleration == pytest.approx(4.0)


def test_emergency_stop_ignores_the_ramps() -> None:
    it = client()
    it.drive(Command(Id.VEL, 400))
    it.wait(2.0)
    it.send(Command(Id.E_STOP))
    it.wait(0.2)
    assert it.firmware.drive.standing
    it.wait(1.0)
    assert it.firmware.drive.standing


@pytest.mark.parametrize("argument", [2811, -1270, -515, 63993, 64516])
def test_wheel_speeds(argument: int) -> None:
    it = client()
    it.drive(Command(Id.VEL2, argument))
    motion = it.wait(4.0)[-1].motion
    word = argument & 0xFFFF
    left, right = (20 * (b - 256 if b > 127 else b) for b in (word >> 8, word & 0xFF))
    assert motion.left == pytest.approx(left, abs=1)
    assert motion.right == pytest.approx(right, abs=1)


@pytest.mark.parametrize(
    ("command", "degrees"),
    [(Command(Id.HEAD, -90), -90), (Command(Id.DHEAD, 45), 65), (Command(Id.HEAD, 179), 179)],
)
def test_headings(command: Command, degrees: float) -> None:
    it = client()
    it.drive(Command(Id.HEAD, 20))
    it.wait(4.0)
    it.send(command)
    motion = it.wait(8.0)[-1].motion
    assert math.degrees(motion.theta * HEADING_RAD) == pytest.approx(degrees, abs=0.3)
    assert it.firmware.drive.velocity.omega == 0.0


@pytest.mark.parametrize("distance", [150, -150, 700])
def test_move_goes_that_far(distance: int) -> None:
    it = client()
    it.drive(Command(Id.MOVE, distance))
    it.wait(6.0)
    assert it.firmware.drive.standing
    assert it.firmware.drive.true_pose.y == pytest.approx(distance / 1e3, abs=0.004)


def test_commands_without_motors_have_no_effect_afterwards_either() -> None:
    it = client()
    it.connect()
    it.send(Command(Id.VEL, 300))
    it.wait(0.5)
    it.send(Command(Id.ENABLE, 1))
    it.wait(1.0)
    assert it.firmware.drive.standing


def test_watchdog_stops_the_robot_and_any_packet_revives_it() -> None:
    it = client()
    it.drive(Command(Id.VEL, 400))
    it.wait(2.0)
    it.wait(1.9, pulse=False)
    assert it.firmware.drive.velocity.v == pytest.approx(0.4)
    it.wait(0.3, pulse=False)
    assert it.firmware.drive.standing
    it.wait(3.0, pulse=False)
    it.send(Command(Id.PULSE))
    it.wait(2.0)
    assert it.firmware.drive.velocity.v == pytest.approx(0.4)


def test_simulator_has_no_watchdog() -> None:
    it = client(personality=SIMULATOR)
    it.drive(Command(Id.VEL, 400))
    it.wait(6.0, pulse=False)
    assert it.firmware.drive.velocity.v == pytest.approx(0.4)


def test_walls_stop_the_robot_and_press_the_bumper() -> None:
    firmware = Firmware(profile(emulated("p3dx-sh")), world=Room(-2.0, 2.0, -2.0, 1.0))
    it = Client(firmware)
    it.drive(Command(Id.VEL, 400))
    report = it.wait(5.0)[-1]
    assert report.motion.front & 0xFE
    assert firmware.drive.true_pose.y == pytest.approx(0.7, abs=0.01)
    assert firmware.drive.standing


# --- reports -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("subclass", "personality"), [("p3dx-sh", ARCOS), ("p3at", ARCOS), ("p3dx", SIMULATOR)]
)
def test_odometry_follows_a_long_drive_through_every_wrap(
    subclass: str, personality: Personality
) -> None:
    """Straight on through the 16-bit counter, and around through the heading's."""
    it = client(subclass, personality)
    telemetry = Telemetry(known_subclasses()[subclass])
    it.drive(Command(Id.SETV, 1200))
    telemetry.take(it.wait(0.1)[0], it.t)
    it.send(Command(Id.VEL, 1200))
    raw = set()
    resolution = math.radians(0.5 if personality is SIMULATOR else 0.05)
    for tick in range(850):
        if tick == 600:
            it.send(Command(Id.RVEL, 25))
        for report in it.wait(0.1):
            telemetry.take(report, it.t)
            raw.add(report.motion.x)
        truth, pose = it.firmware.drive.true_pose, telemetry.odometry.pose
        assert abs(float(wrap_angle(pose.phi - truth.phi))) < resolution
        assert math.hypot(pose.x - truth.x, pose.y - truth.y) < 0.003
    assert telemetry.jumps == 0
    assert min(raw) < 1000
    assert max(raw) > 64000


def test_report_types() -> None:
    for personality, moving in ((ARCOS, 0x33), (SIMULATOR, 0x32)):
        it = client(personality=personality)
        it.drive(Command(Id.VEL, 200))
        it.wait(1.0)
        assert it.packets[-1].id == moving
        it.send(Command(Id.STOP))
        it.wait(2.0)
        assert it.packets[-1].id == 0x32


def test_report_that_forgets_its_readings() -> None:
    it = client(personality=SIMULATOR)
    it.connect()
    it.send(Command(Id.SONAR, 1))
    first, second, *_ = it.wait(0.3)
    assert (first.motion.sonar_count, first.sonar) == (16, ())
    assert len(second.sonar) == 16


def test_sonar_hears_the_walls_and_can_be_switched_off() -> None:
    room = Room(-1.0, 3.0, -4.0, 2.0)
    it = Client(Firmware(profile(emulated("p3dx-sh")), Pose(0.0, 0.0, 0.0), room))
    it.connect()
    ranges = {r.number: r.range for report in it.wait(0.4) for r in report.sonar}
    assert len(ranges) == 16
    assert ranges[0] == 1000 - 136  # to the left
    assert ranges[7] == 3000 - 136  # to the right
    expected = min((2.0 - 0.166) / math.cos(math.radians(10)), 5.0)
    assert ranges[3] == pytest.approx(1e3 * expected, abs=1)
    it.send(Command(Id.SONAR, 0))
    report = it.wait(0.1)[-1]
    assert report.sonar == ()
    assert not report.motion.flags & Flags.SONAR


def test_encoders_and_inputs_once_and_streamed() -> None:
    it = client()
    it.drive(Command(Id.VEL, 200))
    it.wait(3.0)
    (once,) = it.send(Command(Id.ENCODER, 1))
    encoders = decode_encoders(once)
    run_mm = it.firmware.drive.true_pose.y * 1e3
    assert encoders.left == encoders.right == pytest.approx(132 * run_mm, abs=2)
    assert len(decode_inputs(it.send(Command(Id.IOREQUEST, 1))[0]).digital_in) == 4
    assert not [p for p in it.packets[-3:] if p.id == 0x90 and p is not once]
    it.send(Command(Id.ENCODER, 2), Command(Id.IOREQUEST, 2))
    it.packets.clear()
    it.wait(0.5)
    assert [p.id for p in it.packets] == [0x33, 0x90, 0xF0] * 5
    it.send(Command(Id.ENCODER, 0), Command(Id.IOREQUEST, 0))
    it.packets.clear()
    it.wait(0.2)
    assert {p.id for p in it.packets} == {0x33}


def test_slip_is_hidden_from_the_odometry() -> None:
    firmware = Firmware(profile(emulated("p3dx-sh")), slip=Velocity(0.1, 0.0))
    it = Client(firmware)
    it.drive(Command(Id.VEL, 400))
    it.wait(5.0)
    assert firmware.drive.true_pose.y == pytest.approx(0.9 * firmware.drive.wheel_pose.y)
