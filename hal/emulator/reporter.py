"""What the emulated controller reports: standard reports, encoders, inputs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from visctrl.hal.emulator.drive import Drive
from visctrl.hal.emulator.firmware_profile import FirmwareProfile
from visctrl.hal.emulator.world import World
from visctrl.hal.pioneer.commands import Id
from visctrl.hal.pioneer.packet import Packet
from visctrl.hal.pioneer.reports import (
    Encoders,
    Flags,
    Inputs,
    Motion,
    Reading,
    StandardReport,
    Tail,
    Type,
)
from visctrl.hal.pioneer.subclasses import HEADING_RAD
from visctrl.hal.types import Pose
from visctrl.robots.unicycle import to_rep103

if TYPE_CHECKING:
    from visctrl.hal.emulator.firmware import Conditions

#: A request for one packet, and any larger number for a stream of them.
_ONCE = 1
_DIGITAL_IN = b"\xff\x00\x00\xff"
_ANALOG_INPUTS = 9
_NO_CHARGER, _BULK_CHARGE = 0, 1


class Reporter:
    """Builds the packets of one robot.

    Position counters run freely in 16 bits, as the firmware's do; all clients, whatever width
    they assume, see the same steps.
    """

    def __init__(self, profile: FirmwareProfile, world: World) -> None:
        self._profile = profile
        self._world = world
        self.contact = False
        self._streams: dict[int, bool] = {}
        self._sonar = True
        self._next_transducer = 0
        self._forgetful = False

    def begin(self) -> None:
        """Start a session: sonar on, nothing streamed."""
        self._streams.clear()
        self._sonar = True

    def subscribe(self, command: int, number: int, drive: Drive) -> list[bytes]:
        """Carry out SONAR, ENCODER or IOREQUEST."""
        if command == Id.SONAR:
            self._sonar = bool(number)
            self._forgetful = self._sonar and self._profile.personality.forgets_readings
            return []
        self._streams[command] = number > _ONCE
        return self._extra(command, drive) if number == _ONCE else []

    def reset_counters(self) -> None:
        """Forget partial sonar cycles, as SETO does."""
        self._next_transducer = 0

    def due(self, drive: Drive, conditions: Conditions, motors: bool) -> list[bytes]:
        """Return the packets of one cycle: the standard report, then what is streamed."""
        packets = [self._standard(drive, conditions, motors).packet().encode()]
        for command, wanted in self._streams.items():
            if wanted:
                packets += self._extra(command, drive)
        return packets

    def _extra(self, command: int, drive: Drive) -> list[bytes]:
        if command == Id.ENCODER:
            return [Packet(Type.ENCODER, self._encoders(drive).encode()).encode()]
        return [Inputs(_DIGITAL_IN, b"\x00", (0,) * _ANALOG_INPUTS).packet().encode()]

    def _standard(self, drive: Drive, conditions: Conditions, motors: bool) -> StandardReport:
        personality = self._profile.personality
        left, right = self._wheels(drive)
        x, y, theta = self._counters(drive.wheel_pose)
        stalled = conditions.stalled or self.contact
        bumpers = 0b00010000 if conditions.bumper or self.contact else 0
        readings = self._readings(drive.true_pose) if self._sonar else ()
        motion = Motion(
            x=x,
            y=y,
            theta=theta,
            left=left,
            right=right,
            battery=round(conditions.battery_v * 10.0),
            rear=int(stalled),
            front=int(stalled) | bumpers,
            control=_signed(round(drive.heading_goal / HEADING_RAD), 1 << 12),
            flags=self._flags(conditions, motors),
            sonar_count=len(readings),
        )
        tail = Tail(
            gripper=0,
            analog_port=0,
            analog=0,
            digital_in=0xFF,
            digital_out=0,
            battery_x10=round(conditions.battery_v * 10.0),
            charge_state=_BULK_CHARGE if conditions.charging else _NO_CHARGER,
            turn_rate=round(math.degrees(drive.velocity.omega) * 10.0),
            fault_flags=0,
        )
        if self._forgetful:
            readings, self._forgetful = (), False
        moving = personality.says_moving and not drive.standing
        return StandardReport(moving, motion, readings, tail)

    def _flags(self, conditions: Conditions, motors: bool) -> int:
        flags = Flags(0)
        flags |= Flags.MOTORS if motors else Flags(0)
        flags |= Flags.SONAR if self._sonar else Flags(0)
        flags |= Flags.E_STOP if conditions.e_stop else Flags(0)
        return int(flags)

    def _wheels(self, drive: Drive) -> tuple[int, int]:
        """Return the wheels' speeds (mm/s)."""
        half = drive.velocity.omega / self._profile.subclass.arcos.turn_per_difference
        v = drive.velocity.v * 1e3
        return round(v - half), round(v + half)

    def _counters(self, pose: Pose) -> tuple[int, int, int]:
        forward, left, heading = to_rep103(pose).tolist()
        unit = self._profile.subclass.units.distance_mm / 1e3
        step = self._profile.personality.heading_step
        theta = round(heading / HEADING_RAD / step) * step
        x, y = round(forward / unit) & 0xFFFF, round(left / unit) & 0xFFFF
        return x, y, _signed(theta, 1 << 12)

    def _encoders(self, drive: Drive) -> Encoders:
        per_mm = self._profile.config.ticks_per_mm or 0
        forward, turned = drive.run
        half = turned / self._profile.subclass.arcos.turn_per_difference
        ticks = (round((forward * 1e3 + side * half) * per_mm) for side in (-1, 1))
        return Encoders(*(_signed(count, 1 << 32) for count in ticks))

    def _readings(self, pose: Pose) -> tuple[Reading, ...]:
        """Return the next readings: the transducers fire one after the other."""
        ring = self._profile.subclass.sonar
        if ring is None:
            return ()
        places = sorted(ring.transducers.items())
        count = min(self._profile.personality.sonar_per_report, len(places))
        chosen = [(self._next_transducer + k) % len(places) for k in range(count)]
        self._next_transducer = (chosen[-1] + 1) % len(places)
        unit = self._profile.subclass.units.range_mm / 1e3
        return tuple(
            Reading(number, round(min(self._world.sonar(pose, at), ring.range_m) / unit))
            for number, at in (places[k] for k in chosen)
        )


def _signed(value: int, modulus: int) -> int:
    """Return ``value`` modulo ``modulus`` in [-modulus/2, modulus/2)."""
    half = modulus // 2
    return (value + half) % modulus - half
