"""The emulated controller: sessions, commands, reports. Time comes from outside; no I/O.

Behaviour: Pioneer 3 Operations Manual, chapter 6, and what clients in use rely on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from visctrl.hal.emulator.drive import Drive, Ramps
from visctrl.hal.emulator.firmware_profile import FirmwareProfile
from visctrl.hal.emulator.reporter import Reporter
from visctrl.hal.emulator.world import OpenSpace, World
from visctrl.hal.pioneer.commands import (
    HOST_BAUD_CODES,
    Command,
    Id,
    decode_command,
    vel2_wheels,
)
from visctrl.hal.pioneer.packet import Packet
from visctrl.hal.pioneer.reports import Type
from visctrl.hal.types import STANDSTILL, Pose, Velocity

_RATES = {code: baud for baud, code in HOST_BAUD_CODES.items()}
#: Step of the motion (s).
STEP_S = 0.005
_SAME_INSTANT_S = 1e-9


@dataclass
class Conditions:
    """What happens to the robot from outside; faults set these.

    battery_v : voltage. stalled : the wheels are held fast. bumper : a front bumper is pressed.
    e_stop : the emergency stop is pressed, which also switches the motors off.
    charging : the charger is plugged in.
    """

    battery_v: float = 12.8
    stalled: bool = False
    bumper: bool = False
    e_stop: bool = False
    charging: bool = False


class Session(Enum):
    """Where the controller is in the life of a connection."""

    WAITING = "waiting"  # for the next sync packet
    CONNECTED = "connected"
    OPEN = "open"


class Firmware:
    """One robot.

    Parameters
    ----------
    profile : FirmwareProfile
        Which robot, and whose habits.
    start : Pose
        Pose of its axle's centre at time zero.
    world : World
        What it can touch and hear.
    slip : Velocity
        Fractions of v and ω that its odometry does not notice.
    """

    def __init__(
        self,
        profile: FirmwareProfile,
        start: Pose = Pose(0.0, 0.0, 0.0),  # noqa: B008 -- immutable
        world: World | None = None,
        slip: Velocity = STANDSTILL,
    ) -> None:
        self.profile = profile
        self.conditions = Conditions()
        self.drive = _drive(profile, start, slip)
        self.session = Session.WAITING
        self.motors = False
        #: When the wheels first turned, and since when they have been at rest (s).
        self.first_motion: float | None = None
        self.standing_since: float | None = 0.0
        self._world = world or OpenSpace()
        self._reporter = Reporter(profile, self._world)
        self._expected = Id.PULSE
        self._emergency = False
        #: Rate of the host's line that a client has asked for (HOSTBAUD); None as delivered.
        self.host_baud: int | None = None
        self._steps = 0
        self._last_heard = 0.0
        self._next_report = math.inf

    # --- time ----------------------------------------------------------------------------------

    def advance(self, t: float) -> list[bytes]:
        """Live on until ``t`` (s); return the packets sent meanwhile."""
        sent: list[bytes] = []
        while (self._steps + 1) * STEP_S <= t + _SAME_INSTANT_S:
            self._steps += 1
            self._move()
            if self._time >= self._next_report - _SAME_INSTANT_S:
                self._next_report += self._cycle
                sent += self._reporter.due(self.drive, self.conditions, self.motors)
        return sent

    @property
    def _time(self) -> float:
        return self._steps * STEP_S

    @property
    def asleep(self) -> bool:
        """Whether the watchdog holds the robot: it has heard nothing for too long."""
        if self.session is not Session.OPEN or not self.profile.personality.watchdog:
            return False
        return self._time - self._last_heard > (self.profile.config.watchdog or 0) / 1e3

    @property
    def _cycle(self) -> float:
        return (self.profile.config.report_cycle or 100) / 1e3

    def _move(self) -> None:
        if self.conditions.e_stop:
            self.motors = False
        if self.conditions.stalled:
            self.drive.block()
        elif self._emergency or self.asleep or not self.motors:
            self.drive.brake(STEP_S)
            self._emergency = self._emergency and not self.drive.standing
        else:
            before = self.drive.true_pose
            self.drive.follow(STEP_S)
            self._collide(before)
        if not self.drive.standing:
            self.standing_since = None
            self.first_motion = self._time if self.first_motion is None else self.first_motion
        elif self.standing_since is None:
            self.standing_since = self._time

    def _collide(self, before: Pose) -> None:
        touching = not self.drive.standing and self._world.blocked(self.drive.true_pose)
        if touching:
            self.drive.block()
            self.drive.true_pose = before
        self._reporter.contact = touching

    # --- packets -------------------------------------------------------------------------------

    def receive(self, packet: Packet) -> list[bytes]:
        """Take a packet and return the immediate replies."""
        if self.session is Session.OPEN:
            self._last_heard = self._time
            return self._obey(decode_command(packet))
        if self.session is Session.CONNECTED and packet.id == Id.OPEN:
            self._begin()
            return []
        return self._synchronise(packet)

    def hang_up(self) -> None:
        """End the session: the client has gone, and the line says so."""
        self._end()

    def restart(self, says: Type = Type.RESET_B) -> list[bytes]:
        """Start anew, as after a brown-out, and say so with one of the two packet types."""
        self._end()
        return [Packet(says).encode()]

    def _synchronise(self, packet: Packet) -> list[bytes]:
        if packet.id == Id.PULSE:
            self._expected = Id.PULSE  # a client may start over at any time
        if packet.id != self._expected:
            self._end()
            return []
        if packet.id == Id.CLOSE:
            self.session, self._expected = Session.CONNECTED, Id.PULSE
            return [Packet(Type.SYNC2, self.profile.identity.encode()).encode()]
        self.session = Session.WAITING
        self._expected = Id(packet.id + 1)
        return [packet.encode()]

    def _begin(self) -> None:
        self.session = Session.OPEN
        self.motors = self.profile.personality.motors_at_open
        self.drive.rest()
        self._reporter.begin()
        self._last_heard = self._time
        self._next_report = self._time + self._cycle

    def _end(self) -> None:
        self.session, self._expected = Session.WAITING, Id.PULSE
        self.motors = False
        self._emergency = False
        self.drive.rest()
        self.drive.restore_ramps()
        self._next_report = math.inf

    # --- commands ------------------------------------------------------------------------------

    def _obey(self, command: Command) -> list[bytes]:
        """Carry out a command; those that are unknown here are ignored, as firmware does."""
        number = command.argument if isinstance(command.argument, int) else 0
        match command.id:
            case Id.CLOSE:
                self._end()
            case Id.ENABLE:
                self._switch_motors(bool(number))
            case Id.CONFIG:
                return [self.profile.config.packet().encode()]
            case Id.SETO:
                self.drive.reset_odometry()
                self._reporter.reset_counters()
            case Id.STOP:
                self.drive.rest()
            case Id.E_STOP:
                self.drive.rest()
                self._emergency = True
            case Id.HOSTBAUD:
                self.host_baud = _RATES.get(number, self.host_baud)
            case Id.SONAR | Id.ENCODER | Id.IOREQUEST:
                return self._reporter.subscribe(command.id, number, self.drive)
            case Id.SETA | Id.SETV | Id.SETRA | Id.SETRV:
                self._set_ramp(command.id, number)
            case _:
                self._steer(command.id, number)
        return []

    def _switch_motors(self, on: bool) -> None:
        if on and not self.motors:
            self.drive.rest()  # set-points given while the motors were off had no effect
        self.motors = on and not self.conditions.e_stop

    def _steer(self, command: int, number: int) -> None:
        if not self.motors:
            return
        match command:
            case Id.VEL:
                self.drive.set_speed(number / 1e3)
            case Id.RVEL | Id.ROTATE:
                self.drive.set_turn(math.radians(number))
            case Id.VEL2:
                arcos = self.profile.subclass.arcos
                left, right = (arcos.vel2_step_mm_s * wheel for wheel in vel2_wheels(number))
                self.drive.set_speed((left + right) / 2e3)
                self.drive.set_turn((right - left) / 2.0 * arcos.turn_per_difference)
            case Id.MOVE:
                self.drive.move(number / 1e3)
            case Id.HEAD:
                self.drive.head(math.radians(number))
            case Id.DHEAD:
                self.drive.head(self.drive.wheel_pose.phi + math.radians(number))
            case Id.DCHEAD:
                self.drive.head(self.drive.heading_goal + math.radians(number))

    def _set_ramp(self, command: int, number: int) -> None:
        top, size = self._tops(command), abs(number)
        if not size:
            return
        size = min(size, top)
        kind = "acceleration" if number > 0 else "deceleration"
        match command:
            case Id.SETV:
                self.drive.set_ramps(speed=size / 1e3)
            case Id.SETA:
                self.drive.set_ramps(**{kind: size / 1e3})
            case Id.SETRV:
                self.drive.set_ramps(turn_speed=math.radians(size))
            case Id.SETRA:
                self.drive.set_ramps(**{f"turn_{kind}": math.radians(size)})

    def _tops(self, command: int) -> int:
        config = self.profile.config
        tops = {
            Id.SETV: config.speed_top,
            Id.SETA: config.acceleration_top,
            Id.SETRV: config.turn_top,
            Id.SETRA: config.turn_acceleration_top,
        }
        return tops[Id(command)] or 0


def _drive(profile: FirmwareProfile, start: Pose, slip: Velocity) -> Drive:
    config = profile.config
    translation = Ramps(
        (config.speed_max or 0) / 1e3,
        (config.acceleration or 0) / 1e3,
        (config.deceleration or 0) / 1e3,
    )
    rotation = Ramps(
        math.radians(config.turn_max or 0),
        math.radians(config.turn_acceleration or 0),
        math.radians(config.turn_deceleration or 0),
    )
    brake = (config.acceleration_top or 0) / 1e3
    turn_brake = math.radians(config.turn_acceleration_top or 0)
    return Drive(start, translation, rotation, brake, turn_brake, slip)
