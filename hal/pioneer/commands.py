"""Commands to the robot: numbers, arguments, and which of them are legal. No I/O.

Numbers and argument kinds: Pioneer 3 Operations Manual, table "Client command set".
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from visctrl.hal.pioneer.packet import MAX_SENT_COUNT, Packet

#: Type bytes before an argument. The sign of an integer is carried here, not in two's complement.
POSITIVE, NEGATIVE, TEXT = 0x3B, 0x1B, 0x2B

Argument = int | bytes | None


class Id(IntEnum):
    """Command numbers. The sync packets of the handshake share 0, 1 and 2."""

    PULSE = 0
    OPEN = 1
    CLOSE = 2
    POLLING = 3
    ENABLE = 4
    SETA = 5
    SETV = 6
    SETO = 7
    MOVE = 8
    ROTATE = 9
    SETRV = 10
    VEL = 11
    HEAD = 12
    DHEAD = 13
    SAY = 15
    JOYREQUEST = 17
    CONFIG = 18
    ENCODER = 19
    RVEL = 21
    DCHEAD = 22
    SETRA = 23
    SHUTDOWN = 25
    SONAR = 28
    STOP = 29
    DIGOUT = 30
    VEL2 = 32
    GRIPPER = 33
    ADSEL = 35
    GRIPPERVAL = 36
    GRIPREQUEST = 37
    GYROCALCW = 38
    GYROCALCCW = 39
    IOREQUEST = 40
    TTY2 = 42
    GETAUX = 43
    BUMPSTALL = 44
    TCM2 = 45
    JOYDRIVE = 47
    SONARCYCLE = 48
    MOVINGBLINK = 49
    HOSTBAUD = 50
    AUX1BAUD = 51
    AUX2BAUD = 52
    AUX3BAUD = 53
    E_STOP = 55
    E_STALL = 56
    GYRO = 58
    TTY4 = 60
    GETAUX3 = 61
    BATTERYINFO = 62
    TTY3 = 66
    GETAUX2 = 67
    ROTKP = 82
    ROTKV = 83
    ROTKI = 84
    TRANSKP = 85
    TRANSKV = 86
    TRANSKI = 87
    REVCOUNT = 88
    DRIFTFACTOR = 89
    SOUNDTOG = 92
    TICKSMM = 93
    LATVEL = 110
    LATACCEL = 113
    BATTEST = 250
    RESET = 253
    MAINTENANCE = 255


#: Argument of HOSTBAUD for each rate that a controller's host port can take.
HOST_BAUD_CODES = {9600: 0, 19200: 1, 38400: 2, 57600: 3, 115200: 4}

#: These restart the controller; nothing here ever sends them.
FORBIDDEN = frozenset({Id.RESET, Id.MAINTENANCE})

_KNOWN = frozenset(Id)
#: Commands without an argument; the firmware passes over one that comes all the same.
_BARE = frozenset({Id.PULSE, Id.OPEN, Id.CLOSE, Id.SETO, Id.CONFIG, Id.STOP, Id.E_STOP})
_STRINGS = frozenset({Id.POLLING, Id.SAY, Id.TTY2, Id.TTY3, Id.TTY4})
_UNSIGNED = frozenset({Id.ENABLE, Id.SETV, Id.SETRV, Id.SONAR, Id.ENCODER, Id.IOREQUEST})


@dataclass(frozen=True, slots=True)
class Command:
    """A command with its argument: an integer, bytes, or nothing."""

    id: int
    argument: Argument = None

    def packet(self) -> Packet:
        """Return the packet that carries this command.

        Raises
        ------
        ValueError
            The command is forbidden, or its argument cannot be sent.
        """
        if self.id in FORBIDDEN:
            raise ValueError(f"command {self.id} restarts the controller and is never sent")
        packet = Packet(self.id, _encode_argument(self.argument))
        if len(packet.data) + 3 > MAX_SENT_COUNT:
            raise ValueError(f"command {self.id}: {len(packet.data)} data bytes are too many")
        return packet

    def encode(self) -> bytes:
        """Return the command's bytes on the wire (see `packet`)."""
        return self.packet().encode()

    def __str__(self) -> str:
        name = Id(self.id).name if self.id in _KNOWN else f"command {self.id}"
        return name if self.argument is None else f"{name} {self.argument!r}"


def objection(packet: Packet) -> str:
    """Return why a packet is no legal command; empty if it is one.

    Legal is what the manual knows and what firmware is known to take from other makers' clients:
    an integer, or a lone type byte, behind a command that has no argument.
    """
    command = decode_command(packet)
    if packet.id in FORBIDDEN or packet.id not in _KNOWN:
        return "is not a legal command"
    argument, encoded = command.argument, packet.data
    if packet.id in _BARE:
        lone = len(encoded) == 1 and encoded[0] in (POSITIVE, NEGATIVE)
        legal = argument is None or isinstance(argument, int)
        exact = lone or encoded == _encode_argument(argument)
    elif packet.id in _STRINGS:
        legal, exact = isinstance(argument, bytes), encoded == _encode_argument(argument)
    else:
        legal = isinstance(argument, int) and (argument >= 0 or packet.id not in _UNSIGNED)
        # Zero has no sign.
        exact = encoded in (_encode_argument(argument), bytes([NEGATIVE, 0, 0]))
    if not legal:
        return "is not a legal command"
    return "" if exact else "is not encoded as the manual says"


def decode_command(packet: Packet) -> Command:
    """Return the command in a packet, as forgivingly as the firmware.

    Clients send arguments with commands that have none, a type byte without its value, and
    strings whose length byte is wrong; what is there is taken, and what is missing is None.
    """
    data = packet.data
    if len(data) >= 3 and data[0] in (POSITIVE, NEGATIVE):
        value = int.from_bytes(data[1:3], "little")
        return Command(packet.id, value if data[0] == POSITIVE else -value)
    if len(data) >= 2 and data[0] == TEXT:
        return Command(packet.id, data[2 : 2 + data[1]])
    return Command(packet.id)


def vel2_wheels(argument: int) -> tuple[int, int]:
    """Return (left, right) of a VEL2 argument in its own steps, signed.

    One client sends the two bytes as an unsigned number, another as a signed one with its sign
    in the type byte; modulo 65536 they are the same.
    """
    word = argument & 0xFFFF
    left, right = word >> 8, word & 0xFF
    return (left ^ 0x80) - 0x80, (right ^ 0x80) - 0x80


def _encode_argument(argument: Argument) -> bytes:
    if argument is None:
        return b""
    if isinstance(argument, bytes):
        if len(argument) > 0xFF:
            raise ValueError(f"a string of {len(argument)} bytes is too long")
        return bytes([TEXT, len(argument)]) + argument
    if abs(argument) > 0xFFFF:
        raise ValueError(f"argument {argument} does not fit into 16 bits")
    return bytes([NEGATIVE if argument < 0 else POSITIVE]) + abs(argument).to_bytes(2, "little")
