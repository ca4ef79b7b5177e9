"""The packet codec against recorded traffic of real peers, and against garbage."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visctrl.hal.pioneer.commands import Command, Id, decode_command, objection, vel2_wheels
from visctrl.hal.pioneer.config import UNLIMITED, decode_config
from visctrl.hal.pioneer.packet import HEADER, Packet, StreamDecoder, checksum
from visctrl.hal.pioneer.reports import (
    Flags,
    Identity,
    Inputs,
    Motion,
    ReportError,
    Tail,
    decode_encoders,
    decode_gyro,
    decode_identity,
    decode_inputs,
    decode_serial,
    decode_standard_report,
)

DATA = Path(__file__).parents[1] / "data" / "arcos"
VECTORS = json.loads((DATA / "golden_vectors.json").read_text())
SESSIONS = {
    name: [json.loads(line) for line in (DATA / f"{name}_session.jsonl").read_text().splitlines()]
    for name in ("aria", "soar")
}
packets = st.builds(Packet, st.integers(0, 255), st.binary(max_size=252))


def reference_checksum(body: bytes) -> int:
    """The manual's algorithm, byte by byte."""
    total, rest = 0, list(body)
    while len(rest) > 1:
        total = (total + (rest[0] << 8 | rest[1])) & 0xFFFF
        rest = rest[2:]
    return total ^ rest[0] if rest else total


def only(data: bytes) -> Packet:
    (packet,) = StreamDecoder().feed(data)
    return packet


def to_robot(source: str) -> bool:
    return not source.startswith("AMRISim ->")


# --- recorded traffic --------------------------------------------------------------------


@pytest.mark.parametrize("vector", VECTORS, ids=lambda v: v["what"] + " " + v["hex"][:16])
def test_golden_packet_decodes_and_encodes(vector: dict[str, str]) -> None:
    data = bytes.fromhex(vector["hex"])
    packet = only(data)
    assert packet.encode() == data
    described = re.fullmatch(r"(\w+) ?(-?[0-9a-f]*)", vector["what"])
    if described is None or not to_robot(vector["source"]):
        return
    name, argument = described.groups()
    number = Id[name] if name in Id.__members__ else int(name)
    command = decode_command(packet)
    if vector["what"] == "SETO 0":  # a type byte without its value
        assert command == Command(Id.SETO)
        return
    is_text = packet.data[:1] == b"\x2b"
    value = bytes.fromhex(argument) if is_text else int(argument) if argument else None
    assert command == Command(number, value)
    terminator = b"\0" if number in (Id.POLLING, Id.TTY2) else b""  # this client appends one
    assert command.packet().data + terminator == packet.data


@pytest.mark.parametrize("session", SESSIONS)
@pytest.mark.parametrize("piece", [1, 7, 100_000])
def test_recorded_session_decodes_in_any_pieces(session: str, piece: int) -> None:
    for direction in ("c2s", "s2c"):
        lines = [line["hex"] for line in SESSIONS[session] if line["dir"] == direction]
        stream = bytes.fromhex("".join(lines))
        decoder = StreamDecoder()
        found = [
            packet
            for start in range(0, len(stream), piece)
            for packet in decoder.feed(stream[start : start + piece])
        ]
        assert [packet.encode().hex() for packet in found] == lines
        assert decoder.discarded == decoder.pending == 0


@pytest.mark.parametrize("session", SESSIONS)
def test_recorded_commands_encode_to_the_same_bytes(session: str) -> None:
    for line in SESSIONS[session]:
        if line["dir"] == "c2s":
            command = Command(line["id"], line.get("arg"))
            assert command.encode().hex() == line["hex"]
            assert decode_command(only(bytes.fromhex(line["hex"]))) == command


@pytest.mark.parametrize("session", SESSIONS)
def test_recorded_reports_encode_to_the_same_bytes(session: str) -> None:
    for line in SESSIONS[session]:
        packet = only(bytes.fromhex(line["hex"]))
        if line["dir"] == "c2s":
            continue
        if line["name"].startswith("SIP"):
            report = decode_standard_report(packet)
            assert report.packet() == packet
            assert [reading.number for reading in report.sonar] == list(range(16))
            assert report.battery_v == pytest.approx(12.8)
        elif line["name"] == "CONFIGpac":
            config = decode_config(packet)
            assert config.packet() == packet
            assert (config.subclass, config.watchdog, config.firmware) == ("p3dx-sh", 2000, "2.6")
            assert (config.deceleration, config.rev_count) == (300, 16570)
        elif line["name"] == "IOpac":
            inputs = decode_inputs(packet)
            assert inputs.packet() == packet
            assert (inputs.digital_in.hex(), len(inputs.analog)) == ("ff0000ff", 9)
        elif line["name"] == "ENCODERpac":
            encoders = decode_encoders(packet)
            assert Packet(0x90, encoders.encode()) == packet


def vector(what: str) -> Packet:
    return next(only(bytes.fromhex(v["hex"])) for v in VECTORS if what in v["what"])


def test_simulator_identity_and_configuration() -> None:
    identity = decode_identity(vector("SYNC2 reply"))
    assert (identity.name, identity.robot_type, identity.subclass) == ("AMRISim", "Pioneer", "p3dx")
    config = decode_config(vector("CONFIGpac"))
    assert config.speed_top == UNLIMITED
    assert config.charge_threshold == 0
    assert config.power_port is None
    assert config.packet() == vector("CONFIGpac")


def test_simulator_report_while_moving() -> None:
    report = decode_standard_report(vector("while moving"))
    assert not report.moving  # this simulator never says so
    assert (report.motion.left, report.motion.right) == (-124, 0)
    assert report.motion.x == 0xFFFE
    assert report.tail.turn_rate == 200
    assert len(report.sonar) == 16
    assert report.packet() == vector("while moving")


def test_report_that_announces_readings_it_does_not_hold() -> None:
    packet = vector("MALFORMED")
    report = decode_standard_report(packet)
    assert report.motion.sonar_count == 16
    assert report.sonar == ()
    assert report.tail.battery_x10 is None
    assert Flags(report.motion.flags) & Flags.MOTORS
    assert report.packet() == packet


def test_reading_of_an_impossible_transducer_is_not_believed() -> None:
    motion = Motion(sonar_count=2)
    packet = Packet(0x32, motion.encode() + bytes([0, 1, 0, 77, 1, 0]) + bytes(20))
    assert decode_standard_report(packet).sonar == ()


# --- commands ----------------------------------------------------------------------------


@given(st.integers(0, 252), st.integers(-0xFFFF, 0xFFFF) | st.binary(max_size=190) | st.none())
def test_command_round_trip(number: int, argument: int | bytes | None) -> None:
    command = Command(number, argument)
    assert decode_command(only(command.encode())) == command


@pytest.mark.parametrize("number", [Id.RESET, Id.MAINTENANCE])
def test_controller_reset_is_never_encoded(number: Id) -> None:
    with pytest.raises(ValueError, match="never sent"):
        Command(number).encode()


@pytest.mark.parametrize("argument", [0x10000, -0x10000, bytes(256)])
def test_argument_that_cannot_be_sent(argument: int | bytes) -> None:
    with pytest.raises(ValueError, match=r"bytes|bits"):
        Command(Id.SAY, argument).encode()


@given(st.integers(-128, 127), st.integers(-128, 127))
def test_both_encodings_of_wheel_speeds_agree(left: int, right: int) -> None:
    unsigned = (left & 0xFF) << 8 | right & 0xFF
    signed = unsigned - 0x10000 if unsigned >= 0x8000 else unsigned
    assert vel2_wheels(unsigned) == vel2_wheels(signed) == (left, right)


@pytest.mark.parametrize(
    ("number", "data", "says"),
    [
        (Id.VEL, "1bc800", ""),
        (Id.VEL, "", "no legal"),
        (Id.VEL, "3b38ff00", "encoded"),
        (Id.VEL, "1b0000", ""),
        (Id.ENABLE, "1b0100", "no legal"),
        (Id.PULSE, "", ""),
        (Id.OPEN, "3b0100", ""),  # ARIA
        (Id.CONFIG, "3b0100", ""),  # ARIA
        (Id.SETO, "3b", ""),  # Player
        (Id.SETO, "2b0141", "no legal"),
        (Id.GRIPPERVAL, "3b0500", ""),
        (Id.GRIPREQUEST, "3b0100", ""),
        (Id.SOUNDTOG, "3b0000", ""),
        (Id.VEL2, "3bf9f9", ""),  # Player: sixteen bits as they are
        (Id.VEL2, "1bf604", ""),  # ARIA: a magnitude with its sign in the type
        (Id.SAY, "2b02193c", ""),
        (Id.SAY, "2b03193c", "encoded"),
        (200, "3b0100", "no legal"),
        (Id.RESET, "", "no legal"),
    ],
)
def test_legality(number: int, data: str, says: str) -> None:
    found = objection(Packet(number, bytes.fromhex(data)))
    assert found == {"": "", "no legal": "is not a legal command"}.get(
        says, "is not encoded as the manual says"
    )


@pytest.mark.parametrize("session", ["aria", "soar"])
def test_what_other_makers_clients_send_is_legal(session: str) -> None:
    lines = (DATA / f"{session}_session.jsonl").read_text().splitlines()
    sent = [json.loads(line) for line in lines]
    wire = b"".join(bytes.fromhex(line["hex"]) for line in sent if line["dir"] == "c2s")
    packets = StreamDecoder().feed(wire)
    assert len(packets) > 20
    # Commands to the simulator about itself are none of the firmware's.
    assert {packet.id for packet in packets if objection(packet)} <= {224, 225, 237}


FALSE_START = bytes.fromhex("fafb03fa00")


@given(
    st.sampled_from([FALSE_START, FALSE_START * 2, FALSE_START + b"\xfa", b"\xfa", b"\xfa\xfb"]),
    st.integers(0, 255),
    st.binary(max_size=20),
)
def test_a_false_packet_does_not_cost_the_one_behind_it(
    garbage: bytes, number: int, data: bytes
) -> None:
    packet = Packet(number, data)
    assert StreamDecoder().feed(garbage + packet.encode())[-1] == packet
    decoder = StreamDecoder()
    found = [each for byte in garbage + packet.encode() for each in decoder.feed(bytes([byte]))]
    assert found[-1] == packet
    assert decoder.pending <= 2


@given(st.binary(max_size=6), st.integers(0, 255), st.binary(max_size=6))
def test_garbage_that_ends_in_a_header_costs_nothing(body: bytes, number: int, data: bytes) -> None:
    """A false packet made of garbage and the first two bytes of a header, checksum included."""
    wanted = int.from_bytes(HEADER, "big")
    # One pair of bytes makes the checksum of all of them what the header's bytes are.
    even = body[: len(body) // 2 * 2]
    pair = (wanted - checksum(even)) & 0xFFFF
    fake = even + pair.to_bytes(2, "big")
    assert checksum(fake) == wanted
    garbage = HEADER + bytes([len(fake) + 2]) + fake
    packet = Packet(number, data)
    assert StreamDecoder().feed(garbage + packet.encode())[-1] == packet


# --- packets that lie about their length ---------------------------------------------------


@given(st.binary(max_size=60), st.integers(0, 12))
def test_tail_takes_the_fields_that_are_there(surplus: bytes, cut: int) -> None:
    full = Tail(*range(1, 13))
    data = full.encode()
    short = Tail.decode(data[: len(data) - cut])
    assert short.encode() == data[: len(data) - cut]
    assert Tail.decode(data + surplus).encode() == data + surplus


def test_counts_beyond_the_packet_are_refused() -> None:
    with pytest.raises(ReportError, match="shorter"):
        decode_inputs(Packet(0xF0, bytes([4, 0, 0])))
    with pytest.raises(ReportError, match="name"):
        decode_identity(Packet(2, b"AMRISim\0Pioneer\0p3dx"))
    assert decode_inputs(Inputs(b"\x01", b"", (1023,)).packet()).analog == (1023,)
    with pytest.raises(ReportError, match="shorter"):
        decode_gyro(Packet(0x98, bytes([2, 0, 0, 0, 0, 0])))
    samples = decode_gyro(Packet(0x98, bytes([2, 0xFE, 0xFF, 40, 0x00, 0x02, 41])))
    assert samples == ((-2, 40), (512, 41))
    assert decode_serial(Packet(0xB8, b"abc")) == b"abc"
    assert Identity("a", "b", "c").encode() == b"a\0b\0c\0"


# --- the stream decoder --------------------------------------------------------------------


@given(st.binary(max_size=300))
def test_checksum_is_the_manuals(body: bytes) -> None:
    assert checksum(body) == reference_checksum(body)


@given(st.lists(packets, max_size=8), st.data())
def test_pieces_do_not_matter(sent: list[Packet], data: st.DataObject) -> None:
    garbage = st.binary(max_size=20) | st.just(b"\xfa") | st.just(HEADER + b"\xff")
    stream = b"".join(data.draw(garbage) + packet.encode() for packet in sent)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=10)))
    pieces = [stream[a:b] for a, b in itertools.pairwise([0, *cuts, len(stream)])]
    whole, cut = StreamDecoder(), StreamDecoder()
    expected = whole.feed(stream)
    assert [packet for piece in pieces for packet in cut.feed(piece)] == expected
    assert cut.discarded + cut.pending == whole.discarded + whole.pending


@pytest.mark.parametrize(
    "garbage",
    [b"\xfa", b"\xfb", b"\xfa\xfa", HEADER, HEADER + b"\xff", HEADER + b"\x06\x0b", b"WMS2\r",
     HEADER + b"\x00", HEADER * 40],
)  # fmt: skip
def test_packet_right_behind_garbage_is_found_at_its_last_byte(garbage: bytes) -> None:
    wire = Command(Id.VEL, 200).encode()
    decoder = StreamDecoder()
    assert decoder.feed(garbage + wire[:-1]) == []
    assert decoder.feed(wire[-1:]) == [Packet(Id.VEL, bytes([0x3B, 200, 0]))]


@given(st.lists(packets, min_size=1, max_size=5))
def test_reading_as_much_as_is_wanted_never_waits_for_a_second_packet(sent: list[Packet]) -> None:
    decoder, found = StreamDecoder(), []
    stream = memoryview(b"".join(packet.encode() for packet in sent))
    while stream:
        size = decoder.wanted
        assert 1 <= size <= len(stream)
        new = decoder.feed(bytes(stream[:size]))
        assert len(new) <= 1
        found += new
        stream = stream[size:]
    assert len(found) == len(sent)


def test_stamp_is_that_of_the_first_byte() -> None:
    wire = Command(Id.PULSE).encode()
    decoder = StreamDecoder()
    assert decoder.feed(b"junk" + wire[:1], 1.0) == []
    assert decoder.feed(wire[1:4], 2.0) == []
    first, second = decoder.feed(wire[4:] + wire, 3.0)
    assert (first.stamp, second.stamp) == (1.0, 3.0)


def test_memory_is_bounded_by_one_packet() -> None:
    decoder = StreamDecoder()
    decoder.feed((HEADER + b"\xff") * 2000)
    assert decoder.pending <= 258


@settings(max_examples=200)
@given(st.binary(max_size=600), st.lists(st.integers(1, 50), min_size=1, max_size=20))
def test_pure_garbage_never_raises(data: bytes, sizes: list[int]) -> None:
    decoder = StreamDecoder()
    position = 0
    for size in itertools.cycle(sizes):
        if position >= len(data):
            break
        for packet in decoder.feed(data[position : position + size]):
            assert packet.encode() in data
        position += size
    assert decoder.pending <= 258
