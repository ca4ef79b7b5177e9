"""`visctrl emulate-pioneer` as a program of its own."""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from visctrl.cli.main import main
from visctrl.hal.clock import WallClock
from visctrl.hal.pioneer.base import PioneerBase
from visctrl.hal.types import Velocity
from visctrl.robots import load_robot

ROOT = Path(__file__).parents[2]


@pytest.mark.realtime
def test_emulator_serves_a_driver_and_keeps_a_log(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    options = ["--camera", "none", "--port", "socket:0", "--robot", "p3at-sh", "--log", str(log)]
    options += ["--start", "0", "-2", "0", "--fault", "stall@0.8"]
    process = subprocess.Popen(
        [sys.executable, "-m", "visctrl", "emulate-pioneer", *options],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    try:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        assert url.startswith("socket://127.0.0.1:")
        base = PioneerBase(url, load_robot("p3at"), load_robot("p3at").operating, WallClock())
        base.open()
        try:
            deadline = time.monotonic() + 3.0
            while not base.status().faults and time.monotonic() < deadline:
                base.command(Velocity(0.2, 0.0))
                time.sleep(0.1)
            assert "stalled" in base.status().faults[0]
            assert len(base.echoes()) == 16
            assert min(base.echoes().values()) < 5.0  # the hall has walls
        finally:
            base.close()
        process.send_signal(signal.SIGTERM)
        _, messages = process.communicate(timeout=10)
    finally:
        process.kill()
    assert process.returncode == 0
    summary = json.loads(messages.splitlines()[-1])
    assert summary["violations"] == []
    assert -2.0 < summary["camera"]["y_m"] < -1.8
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [line["command"] for line in lines if "command" in line][:4] == [
        "PULSE", "OPEN", "CLOSE", "OPEN",
    ]  # fmt: skip
    truth = [line["truth"] for line in lines if "truth" in line]
    assert math.isclose(truth[0][1], -2.0)
    assert max(row[3] for row in truth) > 0.1


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--robot", "p3dy"], "unknown robot 'p3dy'"),
        (["--fps", "0"], "--fps 0: at most 200"),
        (["--fps", "nan"], "--fps nan"),
        (["--width", "-3"], "Invalid value for '--width'"),
        (["--stream-port", "70000"], "Invalid value for '--stream-port'"),
        (["--port", "socket:70000"], "TCP ports end at 65535"),
        (["--slip", "nan", "0"], "--slip nan 0"),
        (["--start", "nan", "0", "0"], "--start nan 0 0"),
        (["--fault", "lost=5"], "its value lies between 0 and 1"),
        (["--fault", "reset=3"], "between 254 and 255"),
        (["--port", "serial"], "expected pty, socket or socket:PORT"),
        (["--fault", "stal@3"], "did you mean 'stall'"),
        (["--hang-up", "brake"], "unknown hang-up 'brake'; known: stop, watchdog"),
        (["--personality", "x"], "unknown personality 'x'; known: arcos, simulator"),
        (["--camera", "nothing"], "unknown camera 'nothing'"),
        (["--scene", "nothing", "--camera", "none"], "unknown scene 'nothing'"),
        (["--start", "0", "90", "0", "--camera", "none"], "stand in a wall"),
        (["--mount", "nose"], "no camera mount 'nose'"),
        (["--log", "/nowhere/x.jsonl", "--camera", "none"], "--log /nowhere/x.jsonl"),
    ],
)
def test_what_cannot_be_emulated(
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    options: list[str],
    says: str,
) -> None:
    monkeypatch.setattr(sys, "argv", ["visctrl", "emulate-pioneer", *options])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2
    out, err = capfd.readouterr()
    assert says in err
    assert "Traceback" not in err
    assert "http" not in out


def test_port_that_is_taken(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = f"socket:{taken.getsockname()[1]}"
        monkeypatch.setattr(
            sys, "argv", ["visctrl", "emulate-pioneer", "--camera", "none", "--port", port]
        )
        with pytest.raises(SystemExit) as caught:
            main()
    assert caught.value.code == 3
    assert "choose another" in capfd.readouterr().err
