"""Packets from the robot: identity, standard report, configuration, encoders, inputs. No I/O.

Layouts: Pioneer 3 Operations Manual, chapter 6. Numbers are raw, as the firmware counts; the
driver applies the conversion factors of the robot's subclass. Counts inside a packet are only
believed where the packet is long enough for them.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import NamedTuple

from visctrl.hal.pioneer.fields import Fields, coded
from visctrl.hal.pioneer.packet import Packet


class Type(IntEnum):
    """Packet types. Sync replies have 0, 1 and 2."""

    SYNC0 = 0
    SYNC1 = 1
    SYNC2 = 2
    CONFIG = 0x20
    STOPPED = 0x32
    MOVING = 0x33
    ENCODER = 0x90
    GYRO = 0x98
    SERIAL_1 = 0xB0
    SERIAL_2 = 0xB8
    IO = 0xF0
    RESET_A = 0xFE
    RESET_B = 0xFF


SYNC_TYPES = frozenset({Type.SYNC0, Type.SYNC1, Type.SYNC2})
SERIAL_TYPES = frozenset({Type.SERIAL_1, Type.SERIAL_2})
RESET_TYPES = frozenset({Type.RESET_A, Type.RESET_B})


class Flags(IntFlag):
    """Bits of the standard report's FLAGS word that are documented."""

    MOTORS = 1 << 0
    SONAR = 0b1111 << 1
    E_STOP = 1 << 5
    E_STALL = 1 << 6


class ReportError(ValueError):
    """A packet with a valid checksum whose content cannot be what its type says."""


@dataclass(frozen=True)
class Identity(Fields):
    """Reply to SYNC2: who the robot is."""

    name: str = coded("z")
    robot_type: str = coded("z")
    subclass: str = coded("z")


def decode_identity(packet: Packet) -> Identity:
    """Return the identity in a SYNC2 reply.

    Raises
    ------
    ReportError
        It does not hold three strings.
    """
    identity = Identity.decode(packet.data) if packet.id == Type.SYNC2 else None
    if identity is None or identity.subclass is None:
        raise ReportError("the reply to SYNC2 does not name the robot")
    return identity


class Reading(NamedTuple):
    """One sonar echo: transducer number from 0, and its range in the firmware's units."""

    number: int
    range: int


@dataclass(frozen=True)
class Motion(Fields):
    """The fixed beginning of a standard report.

    x, y, theta : odometry counters. left, right : wheel speeds. rear, front : bit 0 is the
    stall of the left or right wheel, bits 1 to 7 are bumpers. control : heading set-point.
    sonar_count : readings that the report claims to hold.
    """

    x: int = coded("H", 0)
    y: int = coded("H", 0)
    theta: int = coded("h", 0)
    left: int = coded("h", 0)
    right: int = coded("h", 0)
    battery: int = coded("B", 0)
    rear: int = coded("B", 0)
    front: int = coded("B", 0)
    control: int = coded("h", 0)
    flags: int = coded("H", 0)
    compass: int = coded("B", 0)
    sonar_count: int = coded("B", 0)


@dataclass(frozen=True)
class Tail(Fields):
    """What follows the sonar readings; older firmware sends less of it."""

    gripper: int | None = coded("B")
    analog_port: int | None = coded("B")
    analog: int | None = coded("B")
    digital_in: int | None = coded("B")
    digital_out: int | None = coded("B")
    battery_x10: int | None = coded("H")
    charge_state: int | None = coded("B")
    turn_rate: int | None = coded("h")
    fault_flags: int | None = coded("H")
    lateral_speed: int | None = coded("h")
    temperature: int | None = coded("b")
    charge_percent: int | None = coded("b")
    time_us: int | None = coded("I")
    flags3: int | None = coded("I")


_MOTION_SIZE = len(Motion().encode())
_READING = struct.Struct("<BH")
_SAMPLE = struct.Struct("<hB")
_SONARS = 32


@dataclass(frozen=True)
class StandardReport:
    """The report (SIP) that an open robot sends every cycle, 100 ms by default."""

    moving: bool
    motion: Motion
    sonar: tuple[Reading, ...] = ()
    tail: Tail = Tail()

    @property
    def battery_v(self) -> float:
        """Battery voltage (V); the byte in front saturates, the newer word does not."""
        return (self.tail.battery_x10 or self.motion.battery) / 10.0

    def packet(self) -> Packet:
        """Return the packet that carries this report."""
        readings = b"".join(_READING.pack(*reading) for reading in self.sonar)
        data = self.motion.encode() + readings + self.tail.encode()
        return Packet(Type.MOVING if self.moving else Type.STOPPED, data)


def is_standard_report(packet: Packet) -> bool:
    """Return whether this is a standard report, of this or an older firmware (0x30 to 0x34)."""
    return 0x30 <= packet.id <= 0x34


def decode_standard_report(packet: Packet) -> StandardReport:
    """Return the standard report in a packet.

    The sonar count is believed only if that many readings fit and each names a transducer that
    can exist; otherwise what follows it is left in ``tail.surplus``, undecoded.

    Raises
    ------
    ReportError
        It is another packet, or too short for its fixed part.
    """
    if not is_standard_report(packet) or len(packet.data) < _MOTION_SIZE:
        raise ReportError(f"packet {packet.id:#04x} of {len(packet.data)} bytes is no report")
    motion = Motion.decode(packet.data[:_MOTION_SIZE])
    rest = packet.data[_MOTION_SIZE:]
    moving = bool(packet.id & 1)
    readings_end = motion.sonar_count * _READING.size
    readings = tuple(Reading(*each) for each in _READING.iter_unpack(_whole(rest[:readings_end])))
    if readings_end > len(rest) or any(reading.number >= _SONARS for reading in readings):
        return StandardReport(moving, motion, tail=Tail(surplus=rest))
    return StandardReport(moving, motion, readings, Tail.decode(rest[readings_end:]))


def _whole(data: bytes) -> bytes:
    return data[: len(data) // _READING.size * _READING.size]


@dataclass(frozen=True)
class Encoders(Fields):
    """Accumulated encoder counts of both wheels."""

    left: int = coded("i")
    right: int = coded("i")


@dataclass(frozen=True)
class Inputs:
    """Digital inputs, digital outputs and analogue inputs (0 to 1023), raw."""

    digital_in: bytes = b""
    digital_out: bytes = b""
    analog: tuple[int, ...] = ()
    surplus: bytes = b""

    def packet(self) -> Packet:
        """Return the packet that carries this report."""
        data = bytes([len(self.digital_in)]) + self.digital_in
        data += bytes([len(self.digital_out)]) + self.digital_out
        data += struct.pack(f"<B{len(self.analog)}H", len(self.analog), *self.analog)
        return Packet(Type.IO, data + self.surplus)


def decode_encoders(packet: Packet) -> Encoders:
    """Return the encoder report in a packet.

    Raises
    ------
    ReportError
        It is another packet, or too short.
    """
    encoders = Encoders.decode(packet.data) if packet.id == Type.ENCODER else None
    if encoders is None or encoders.right is None:
        raise ReportError("not an encoder report")
    return encoders


def decode_inputs(packet: Packet) -> Inputs:
    """Return the input report in a packet.

    Raises
    ------
    ReportError
        It is another packet, or one of its counts exceeds its length.
    """
    data = packet.data
    if packet.id != Type.IO:
        raise ReportError("not an input report")
    digital_in, data = _counted(data, 1)
    digital_out, data = _counted(data, 1)
    analog, surplus = _counted(data, 2)
    values = struct.unpack(f"<{len(analog) // 2}H", analog)
    return Inputs(digital_in, digital_out, values, surplus)


class TurnSample(NamedTuple):
    """One sample of the gyro: rate and temperature, raw."""

    rate: int
    temperature: int


def decode_gyro(packet: Packet) -> tuple[TurnSample, ...]:
    """Return the samples in a gyro report.

    Raises
    ------
    ReportError
        It is another packet, or its count exceeds its length.
    """
    if packet.id != Type.GYRO:
        raise ReportError("not a gyro report")
    samples, _ = _counted(packet.data, _SAMPLE.size)
    return tuple(map(TurnSample._make, _SAMPLE.iter_unpack(samples)))


def decode_serial(packet: Packet) -> bytes:
    """Return the bytes that a device on one of the controller's own serial ports has sent.

    Raises
    ------
    ReportError
        It is another packet.
    """
    if packet.id not in SERIAL_TYPES:
        raise ReportError("not from an auxiliary port")
    return packet.data


def _counted(data: bytes, size: int) -> tuple[bytes, bytes]:
    """Return the items of ``size`` bytes that ``data`` begins with a count of, and the rest."""
    if not data or 1 + data[0] * size > len(data):
        raise ReportError("a report is shorter than its counts say")
    end = 1 + data[0] * size
    return data[1:end], data[end:]
