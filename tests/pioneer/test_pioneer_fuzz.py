"""The codec on damaged streams: a million of them with VISCTRL_FUZZ_STREAMS=1000000.

VISCTRL_FUZZ_SEED makes them others.
"""

from __future__ import annotations

import json
import os
import random
from pathlib import Path

from hypothesis import HealthCheck, given, note, settings
from hypothesis import strategies as st

from visctrl.hal.pioneer.commands import Command, Id, decode_command
from visctrl.hal.pioneer.config import decode_config
from visctrl.hal.pioneer.packet import HEADER, Packet, StreamDecoder
from visctrl.hal.pioneer.reports import (
    ReportError,
    StandardReport,
    decode_encoders,
    decode_gyro,
    decode_identity,
    decode_inputs,
    decode_serial,
    decode_standard_report,
)

STREAMS = int(os.environ.get("VISCTRL_FUZZ_STREAMS", "2000"))
SEED = os.environ.get("VISCTRL_FUZZ_SEED", "0")
#: Streams of one example; their mutations follow from the number that hypothesis chooses.
BATCH = 100
DATA = Path(__file__).parents[1] / "data" / "arcos"
DECODERS = (
    decode_standard_report,
    decode_config,
    decode_encoders,
    decode_inputs,
    decode_identity,
    decode_gyro,
    decode_serial,
)


def corpus() -> list[bytes]:
    """Return every packet that was recorded between other makers' programs."""
    wire = [vector["hex"] for vector in json.loads((DATA / "golden_vectors.json").read_text())]
    for session in ("aria", "soar"):
        lines = (DATA / f"{session}_session.jsonl").read_text().splitlines()
        wire += [json.loads(line)["hex"] for line in lines]
    return [bytes.fromhex(text) for text in wire]


CORPUS = corpus()
AFTER = [Command(Id.VEL, 1).packet(), Command(Id.RVEL, 2).packet(), Command(Id.PULSE).packet()]
CLEAN = b"".join(packet.encode() for packet in AFTER)


def reference_checksum(body: bytes) -> int:
    """The manual's algorithm, byte by byte."""
    total, rest = 0, list(body)
    while len(rest) > 1:
        total = (total + (rest[0] << 8 | rest[1])) & 0xFFFF
        rest = rest[2:]
    return total ^ rest[0] if rest else total


def mutate(stream: bytearray, chance: random.Random) -> None:
    """Damage a stream in place: flips, losses, insertions, false headers, cuts, echoes."""
    for _ in range(chance.randrange(1, 8)):
        at = chance.randrange(len(stream))
        match chance.randrange(7):
            case 0:
                stream[at] ^= 1 << chance.randrange(8)
            case 1:
                del stream[at : at + chance.randrange(1, 20)]
            case 2:
                stream[at:at] = chance.randbytes(chance.randrange(1, 20))
            case 3:
                stream[at:at] = HEADER + bytes([chance.randrange(256)])
            case 4:
                stream[at : at + 3] = HEADER + b"\xff"
            case 5:
                del stream[at:]
            case _:
                stream[at:at] = stream[max(0, at - chance.randrange(1, 40)) : at]
        stream += b"\0" if not stream else b""


def decode_all(packet: Packet) -> None:
    """Decode a packet as everything that it may be."""
    for decode in DECODERS:
        try:
            decoded = decode(packet)
        except ReportError:
            continue
        if isinstance(decoded, StandardReport) and packet.id in (0x32, 0x33):
            assert decoded.packet() == packet
    decode_command(packet)


def check(stream: bytes) -> bool:
    """Decode a damaged stream with clean packets behind it.

    No exception; no packet with a wrong checksum; behind the damage all packets are found, but
    for at most one. That one is missing where the damage has made a false packet, checksum
    included, that ends within it: return whether it was so.
    """
    decoder = StreamDecoder()
    for packet in decoder.feed(stream):
        body = bytes([packet.id]) + packet.data
        assert HEADER + bytes([len(body) + 2]) + body in stream
        assert body + reference_checksum(body).to_bytes(2, "big") in stream
        decode_all(packet)
    behind = decoder.feed(CLEAN)
    assert behind[-2:] == AFTER[1:]
    assert len(behind) <= len(AFTER)
    return behind[:-2] != AFTER[:1]


def test_mutated_streams() -> None:
    streams = lost = 0

    @settings(max_examples=max(1, STREAMS // BATCH), suppress_health_check=list(HealthCheck))
    @given(st.integers(0, 2**64 - 1))
    def fuzz(seed: int) -> None:
        nonlocal streams, lost
        chance = random.Random(f"{SEED} {seed}")
        for _ in range(BATCH):
            stream = bytearray(b"".join(chance.choices(CORPUS, k=3)))
            mutate(stream, chance)
            note(stream.hex())
            lost += check(bytes(stream))
            streams += 1

    fuzz()
    print(f"{streams} streams, {lost} false packets")
    # By chance, one false header in 65536 is followed by its checksum.
    assert lost <= 1 + streams // 10_000
    assert streams >= STREAMS


@given(st.binary(max_size=252), st.integers(0, 255))
def test_any_content_decodes_or_is_refused(data: bytes, kind: int) -> None:
    decode_all(Packet(kind, data))
