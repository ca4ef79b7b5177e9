"""The guide's backend works as printed, with a robot that a path names; the tree knows neither."""

from __future__ import annotations

import json
import re
import socketserver
import sys
import threading
import time
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from visctrl.cli.main import main
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.robots.unicycle import along_arc
from visctrl.runtime.registry import REGISTRIES

TESTS = Path(__file__).parent
GUIDE = TESTS.parent / "docs" / "plugins.md"
SCENARIO = """
camera: {name: small.yaml}
perception: {name: blind}
estimator: {name: toy}
approach: {enabled: false}
controller: {name: toy, v: 0.3, omega: 0.0, drive_s: 1.0}
safety: {acceleration_m_s2: 1.0}
"""
CALIBRATION = """
name: small
width: 160
height: 120
xi: 0.0
fx: 100.0
fy: 100.0
cx: 79.5
cy: 59.5
"""
Call = Callable[..., tuple[int, str, str]]


class Robot(socketserver.ThreadingTCPServer):
    """An exact unicycle that answers lines, and remembers what it was told."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Talk)
        self.pose, self.velocity, self.at = (0.0, 0.0, 0.0), STANDSTILL, time.monotonic()
        self.heard: list[Velocity] = []
        self.hangs_up_after: int | None = None

    def obey(self, line: bytes) -> bytes:
        now = time.monotonic()
        self.pose = along_arc(self.pose, self.velocity, now - self.at)
        self.velocity, self.at = Velocity(*map(float, line.split())), now
        self.heard.append(self.velocity)
        return (" ".join(map(str, (*self.pose, *self.velocity))) + "\n").encode()


class Talk(socketserver.StreamRequestHandler):
    server: Robot

    def handle(self) -> None:
        for line in self.rfile:
            if len(self.server.heard) == self.server.hangs_up_after:
                self.server.velocity = STANDSTILL
                return
            self.wfile.write(self.server.obey(line))


class Film:
    """Stands in for `cv2.VideoCapture`: noisy pictures of one scene, 50 a second."""

    def __init__(self, *source: object) -> None:
        self._chance = np.random.default_rng(1)
        coarse = self._chance.uniform(0.0, 255.0, (15, 20)).astype(np.float32)
        self._scene = cv2.resize(coarse, (160, 120), interpolation=cv2.INTER_CUBIC)

    def isOpened(self) -> bool:
        return True

    def get(self, what: int) -> float:
        return 0.0

    def set(self, what: int, value: float) -> bool:
        return True

    def grab(self) -> bool:
        time.sleep(0.02)
        return True

    def retrieve(self) -> tuple[bool, Any]:
        noisy = self._scene + self._chance.normal(0.0, 2.0, self._scene.shape)
        grey = np.clip(noisy, 0, 255).astype(np.uint8)
        return True, np.repeat(grey[:, :, None], 3, axis=2)

    def release(self) -> None:
        pass


@pytest.fixture
def robot() -> Iterator[Robot]:
    with Robot() as server:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        yield server
        server.shutdown()


@pytest.fixture
def visctrl(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Call:
    """A folder with what the guide asks for, and a function that runs the program in it."""
    blocks = re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    (code,) = (block for block in blocks if "class Rover(Backend)" in block)
    (tmp_path / "rover.py").write_text(code, encoding="utf-8")
    (tmp_path / "small.yaml").write_text(CALIBRATION)
    (tmp_path / "toy.yaml").write_text(SCENARIO)
    source = resources.files("visctrl.robots") / "p3dx" / "robot.yaml"
    data = yaml.safe_load(source.read_text(encoding="utf-8"))
    mine = {key: value for key, value in data.items() if key not in ("sonar", "arcos")}
    (tmp_path / "my_rover").mkdir()
    (tmp_path / "my_rover" / "robot.yaml").write_text(yaml.safe_dump({**mine, "name": "rover"}))
    monkeypatch.chdir(tmp_path)
    for folder in (tmp_path, TESTS / "runtime", TESTS / "cli"):
        monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr(cv2, "VideoCapture", Film)
    monkeypatch.setitem(REGISTRIES.perception.builtin, "blind", "blind_plugins:Blind")
    monkeypatch.setitem(REGISTRIES.estimators.builtin, "toy", "toy_plugins:ToyEstimator")
    monkeypatch.setitem(REGISTRIES.controllers.builtin, "toy", "toy_plugins:ToyController")

    def call(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["visctrl", *arguments])
        with pytest.raises(SystemExit) as caught:
            main()
        out, err = capfd.readouterr()
        assert "Traceback" not in err
        return int(caught.value.code or 0), out, err

    return call


def devices(robot: Robot) -> list[str]:
    port = f"127.0.0.1:{robot.server_address[1]}"
    ours = ["--backend", "rover:Rover", "--robot", "./my_rover"]
    return [*ours, "--port", port, "--camera-url", "0"]


def test_teaching_and_driving(visctrl: Call, robot: Robot) -> None:
    code, _, messages = visctrl("teach", "toy.yaml", *devices(robot))
    assert code == 0, messages
    run = ["run", "toy.yaml", "--json", "--out", "o", "--target", "target.npz"]
    code, out, messages = visctrl(*run, *devices(robot))
    assert code == 0, messages
    assert json.loads(out)["status"] == "reached"
    speeds = [heard.v for heard in robot.heard]
    assert max(speeds) == pytest.approx(0.3)
    assert max(np.diff(speeds)) < 0.1 * 1.0 + 0.05, "ramped by the session, not by the backend"
    assert robot.heard[-1] == STANDSTILL
    assert robot.pose[1] > 0.1
    effective = yaml.safe_load(Path("o/config.yaml").read_text(encoding="utf-8"))
    assert effective["robot"] == str(Path("my_rover").resolve())
    assert effective["rover:Rover"]["address"] == devices(robot)[5]


def test_a_robot_that_hangs_up_ends_the_run(visctrl: Call, robot: Robot) -> None:
    assert visctrl("teach", "toy.yaml", *devices(robot))[0] == 0
    robot.hangs_up_after = len(robot.heard) + 6
    run = ["run", "toy.yaml", "--quiet", "--out", "o", "--target", "target.npz"]
    code, _, messages = visctrl(*run, *devices(robot))
    assert code == 3
    assert "no answer" in messages


def test_a_robot_that_is_not_there(visctrl: Call, robot: Robot) -> None:
    assert visctrl("teach", "toy.yaml", *devices(robot))[0] == 0
    run = ["run", "toy.yaml", "--quiet", "--target", "target.npz", *devices(robot)]
    code, _, messages = visctrl(*run, "--port", "127.0.0.1:1")
    assert code == 3
    assert "is it switched on?" in messages
    code, _, messages = visctrl(*run, "--gui")
    assert code == 2
    assert "--gui: not an option of backend 'rover:Rover', but of: sim" in messages
