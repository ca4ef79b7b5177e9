"""A run in the Foxglove app: what the file holds, what is served, and that nobody is waited for."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

from visctrl.cli.main import main
from visctrl.hal.types import Frame
from visctrl.robots.errors import InputError
from visctrl.robots.unicycle import to_rep103
from visctrl.runtime.plan import Plan
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.session import run_session
from visctrl.viewers.run_pictures import run_with_pictures

foxglove = pytest.importorskip("foxglove")
reading = pytest.importorskip("mcap.reader")

from visctrl.viewers.foxglove.stream import ViewerStream  # noqa: E402

MakePlan = Callable[..., Plan]
SCHEMAS = {
    "/camera/image": "foxglove.CompressedImage",
    "/camera/calibration": "foxglove.CameraCalibration",
    "/camera/tracks": "foxglove.ImageAnnotations",
    "/pose": "foxglove.PoseInFrame",
    "/path": "foxglove.PosesInFrame",
    "/tf": "foxglove.FrameTransforms",
    "/scene": "foxglove.SceneUpdate",
}


class Keeps(Observer):
    def __init__(self) -> None:
        self.records: list[TickRecord] = []

    def on_tick(self, record: TickRecord) -> None:
        self.records.append(record)


def messages(path: Path) -> dict[str, list[tuple[str, int, bytes]]]:
    """Return schema name, time and data of every message by topic."""
    found: dict[str, list[tuple[str, int, bytes]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in reading.make_reader(file).iter_messages():
            name = schema.name if schema is not None else ""
            found.setdefault(channel.topic, []).append((name, message.log_time, message.data))
    return found


@pytest.fixture
def recorded(toy_plan: MakePlan, tmp_path: Path) -> tuple[Path, list[TickRecord]]:
    keeps = Keeps()
    run_with_pictures(
        toy_plan({"controller.drive_s": 1.5}), tmp_path / "run", mcap=True, observers=[keeps]
    )
    return tmp_path / "run" / "run.mcap", keeps.records


def doubles(data: bytes, tag: int) -> list[float]:
    """Return the double fields with a number anywhere in an encoded message, in order."""
    wanted = bytes([tag << 3 | 1])
    places = [k + 1 for k in range(len(data) - 8) if data[k : k + 1] == wanted]
    return [struct.unpack("<d", data[k : k + 8])[0] for k in places]


def test_the_file_holds_every_tick_in_foxglove_schemas(
    recorded: tuple[Path, list[TickRecord]],
) -> None:
    path, records = recorded
    found = messages(path)
    assert {topic: rows[0][0] for topic, rows in found.items() if topic in SCHEMAS} == SCHEMAS
    for topic in ("/camera/image", "/camera/tracks", "/pose", "/tf", "/tick"):
        assert len(found[topic]) == len(records)
    times = [when for _, when, _ in found["/tick"]]
    steps = np.diff(np.array(times, dtype=np.int64)) / 1e9
    assert steps == pytest.approx(np.diff([record.t for record in records]), abs=1e-6)
    assert b"\xff\xd8\xff" in found["/camera/image"][0][2], "a JPEG"


def test_numbers_to_plot_are_those_of_the_tick(recorded: tuple[Path, list[TickRecord]]) -> None:
    path, records = recorded
    rows = [json.loads(data) for _, _, data in messages(path)["/tick"]]
    for row, record in zip(rows, records, strict=True):
        assert row["t_s"] == record.t
        assert row["sent"]["v_m_s"] == record.sent.v
        assert row["features"] == len(record.views)
        assert row["signals"]["toy"] == dict(record.signals[-1][1])
        assert record.truth is not None
        assert row["error"]["y_m"] == record.truth.y
    assert rows[0]["battery_v"] == 12.5


def test_poses_are_in_rep_103_axes(recorded: tuple[Path, list[TickRecord]]) -> None:
    path, records = recorded
    for (_, _, data), record in zip(messages(path)["/pose"], records, strict=True):
        x, _, yaw = to_rep103(record.truth)
        assert any(value == pytest.approx(x, abs=1e-12) for value in doubles(data, 1))
        assert any(value == pytest.approx(np.cos(yaw / 2)) for value in doubles(data, 4))


def test_a_run_that_never_began_leaves_no_file(toy_plan: MakePlan, tmp_path: Path) -> None:
    class Refuses(Observer):
        def on_stage(self, stage: str) -> None:
            raise InputError("no")

    with pytest.raises(InputError):
        run_with_pictures(toy_plan(), tmp_path / "run", mcap=True, observers=[Refuses()])
    assert not (tmp_path / "run").exists()


# --- live --------------------------------------------------------------------------------------


class Viewer:
    """A small client of the Foxglove protocol that subscribes to everything."""

    def __init__(self, stream: ViewerStream) -> None:
        assert stream.gate is not None
        url = urlsplit(stream.gate.url)
        self.socket = socket.socket()
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self.socket.settimeout(10.0)
        self.socket.connect(("127.0.0.1", url.port))
        key = base64.b64encode(os.urandom(16)).decode()
        self.socket.sendall(
            f"GET /?{url.query} HTTP/1.1\r\nHost: {url.netloc}\r\nUpgrade: websocket\r\n"
            f"Connection: Upgrade\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode()
        )
        self.buffer = b""
        while b"\r\n\r\n" not in self.buffer:
            self.buffer += self.socket.recv(4096)
        head, _, self.buffer = self.buffer.partition(b"\r\n\r\n")
        assert b" 101 " in head.splitlines()[0]

    def frame(self) -> tuple[int, bytes]:
        """Return kind and content of the next message."""
        kind, size = self._take(2)
        length = size & 127
        if length == 126:
            (length,) = struct.unpack(">H", self._take(2))
        elif length == 127:
            (length,) = struct.unpack(">Q", self._take(8))
        return kind & 15, self._take(length)

    def subscribe(self) -> set[str]:
        """Wait until channels are offered, subscribe to all, and return their topics."""
        while True:
            kind, data = self.frame()
            message = json.loads(data) if kind == 1 else {}
            if message.get("op") == "advertise":
                break
        channels = message["channels"]
        wanted = [{"id": k, "channelId": channel["id"]} for k, channel in enumerate(channels)]
        self._send(json.dumps({"op": "subscribe", "subscriptions": wanted}).encode())
        return {channel["topic"] for channel in channels}

    def _take(self, count: int) -> bytes:
        while len(self.buffer) < count:
            data = self.socket.recv(65536)
            assert data, "closed"
            self.buffer += data
        taken, self.buffer = self.buffer[:count], self.buffer[count:]
        return taken

    def _send(self, data: bytes) -> None:
        mask = os.urandom(4)
        masked = bytes(byte ^ mask[k % 4] for k, byte in enumerate(data))
        size = (
            bytes([128 | len(data)]) if len(data) < 126 else b"\xfe" + struct.pack(">H", len(data))
        )
        self.socket.sendall(b"\x81" + size + mask + masked)


@pytest.fixture
def stream(toy_plan: MakePlan) -> Iterator[ViewerStream]:
    stream = ViewerStream.to_viewers(toy_plan(), "127.0.0.1", 0, "--live")
    yield stream
    with suppress(Exception):
        stream.close()


def test_a_viewer_gets_what_happens(toy_plan: MakePlan, stream: ViewerStream) -> None:
    viewer = Viewer(stream)
    assert set(SCHEMAS) <= viewer.subscribe()
    time.sleep(0.2)
    run_session(toy_plan({"controller.drive_s": 1.0}), observers=[stream])
    data = 0
    while data < 5:
        kind, content = viewer.frame()
        data += kind == 2 and content[0] == 1
    viewer.socket.close()


def knock(stream: ViewerStream, query: str, **fields: str) -> str:
    """Ask for a WebSocket; return the status line, empty if the door is shut."""
    assert stream.gate is not None
    with socket.create_connection(("127.0.0.1", stream.gate.address.port), timeout=10.0) as door:
        head = {"Host": f"127.0.0.1:{stream.gate.address.port}", "Upgrade": "websocket"} | fields
        lines = "".join(f"{name}: {value}\r\n" for name, value in head.items())
        door.sendall(f"GET /{query} HTTP/1.1\r\n{lines}\r\n".encode())
        return door.recv(4096).decode("latin-1").partition("\r\n")[0]


@pytest.mark.parametrize(
    "fields",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "https://evil.example"},
        {"Origin": "null"},
        {"Origin": "https://app.foxglove.dev.evil.example"},
        {"Host": "evil.example"},
        {"Host": "evil.example:8765", "Origin": "http://evil.example:8765"},
        {"Host": ""},
    ],
)
def test_a_page_of_another_site_cannot_look_through_the_camera(
    stream: ViewerStream, fields: dict[str, str]
) -> None:
    assert stream.gate is not None
    query = f"?{urlsplit(stream.gate.url).query}"
    assert knock(stream, query, **fields) == "HTTP/1.1 403 Forbidden"


def test_without_the_token_nobody_looks(stream: ViewerStream) -> None:
    assert stream.gate is not None
    token = urlsplit(stream.gate.url).query
    assert len(token) > len("token=") + 20
    for query in ("", "?token=", f"?{token[:-1]}", f"?{token}x", "?token=é"):
        assert knock(stream, query) == "HTTP/1.1 401 Unauthorized"
    assert knock(stream, f"?{token}", Upgrade="h2c") == "HTTP/1.1 400 Bad Request"
    for origin in ("https://app.foxglove.dev", "file://", "http://localhost:8080"):
        websocket = {"Connection": "Upgrade", "Sec-WebSocket-Key": "MDEyMzQ1Njc4OWFiY2RlZg=="}
        version = {"Sec-WebSocket-Version": "13", "Sec-WebSocket-Protocol": "foxglove.sdk.v1"}
        assert " 101 " in knock(stream, f"?{token}", Origin=origin, **websocket, **version)


def test_a_viewer_that_never_reads_delays_no_tick_and_not_the_end(
    toy_plan: MakePlan, stream: ViewerStream
) -> None:
    """Megabytes are offered to viewers that take kilobytes; one vanishes on the way."""
    viewers = [Viewer(stream) for _ in range(3)]
    for viewer in viewers:
        viewer.subscribe()
    time.sleep(0.2)
    noise = np.random.default_rng(0).integers(0, 255, (600, 800), dtype=np.uint8)
    keeps = Keeps()
    run_session(toy_plan({"controller.drive_s": 0.3}), observers=[keeps])
    record = keeps.records[0]._replace(frame=Frame(0.0, 1, noise))
    took = []
    for k in range(120):
        began = time.monotonic()
        stream.on_tick(record)
        took.append(time.monotonic() - began)
        if k == 60:
            viewers.pop().socket.close()
        time.sleep(0.01)
    assert sorted(took)[len(took) // 2] < 0.01
    assert max(took) < 2.0
    assert stream.problem == ""
    began = time.monotonic()
    stream.close()
    assert time.monotonic() - began < 8.0
    for viewer in viewers:
        viewer.socket.close()


def test_an_encoder_that_is_too_slow_costs_ticks_and_no_time(
    toy_plan: MakePlan, stream: ViewerStream, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream._publisher, "publish", lambda record: time.sleep(0.05))
    outcome = run_session(toy_plan(), observers=[stream])
    assert outcome.summary["ticks"] == 51
    assert 0 < stream.given_up < 51


# --- the command line --------------------------------------------------------------------------


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["visctrl", *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    return int(caught.value.code or 0)


@pytest.mark.parametrize("option", ["--mcap", "--live"])
def test_without_the_package_its_install_command_is_told(
    option: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("visctrl.viewers.foxglove.stream._PACKAGE", "no_such_package")
    out = tmp_path / "run"
    assert call(monkeypatch, "run", "mock", option, "--out", str(out)) == 2
    assert f"{option} needs an extra package: pip install 'visctrl[viz]'" in capsys.readouterr().err
    assert not out.exists()


def test_a_port_in_use_by_another_viewer_is_bad_input(
    stream: ViewerStream,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    where = f"127.0.0.1:{stream.gate.address.port}"
    out = tmp_path / "run"
    assert call(monkeypatch, "run", "mock", "--live-address", where, "--out", str(out)) == 2
    assert f"--live-address {where}: cannot listen there" in capsys.readouterr().err
    assert not out.exists()
