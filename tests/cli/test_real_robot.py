"""`visctrl run --backend pioneer` over a real port and a real stream, faults included."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest

from hal.central_camera import CentralCamera
from hal.pioneer.emulator.character import character
from hal.pioneer.emulator.emulator import Emulator
from hal.pioneer.emulator.firmware import Firmware
from hal.pioneer.emulator.ports import PtyPort
from hal.pioneer.emulator.stream import MjpegServer
from visctrl.cli.main import main
from visctrl.runtime.registry import REGISTRIES
from visctrl.target_view import TargetView, load_target

pytestmark = pytest.mark.realtime
ROOT = Path(__file__).parents[2]
MODEL = CentralCamera(
    name="small", width=160, height=120, xi=0.0, fx=100.0, fy=100.0, cx=79.5, cy=59.5
)
SCENARIO = """
backend: pioneer
camera: {name: small.yaml}
perception: {name: blind}
estimator: {name: toy}
controller: {name: toy, v: 0.4, drive_s: 20}
approach: {enabled: false}
safety: {acceleration_m_s2: 1.0}
target: {file: target.npz}
"""
Run = Callable[..., tuple[int, dict[str, object], str]]


@dataclass
class Site:
    """An emulated robot, a camera that sees noise, and where the program runs."""

    emulator: Emulator
    server: MjpegServer
    folder: Path
    filming: threading.Event = field(default_factory=threading.Event)

    @property
    def devices(self) -> tuple[str, ...]:
        return ("--port", self.emulator.url, "--camera-url", self.server.url)

    def film(self, stop: threading.Event) -> None:
        rng = np.random.default_rng(0)
        while not stop.wait(0.05):
            if self.filming.is_set():
                picture = rng.integers(0, 255, (MODEL.height, MODEL.width), dtype=np.uint8)
                self.server.publish(cv2.imencode(".jpg", picture)[1].tobytes())

    def when_at_speed(self, act: Callable[[], None]) -> threading.Thread:
        """Let something happen once the robot drives at full speed."""

        def watch() -> None:
            deadline = time.monotonic() + 10.0
            while self.emulator.velocity.v < 0.4 and time.monotonic() < deadline:
                time.sleep(0.01)
            self.began = self.emulator.now()
            act()

        thread = threading.Thread(target=watch)
        thread.start()
        return thread

    began = math.inf


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "toy.yaml").write_text(SCENARIO)
    (tmp_path / "small.yaml").write_text(MODEL.model_dump_json())
    TargetView(np.zeros((1, 120, 160), np.uint8), MODEL).save(tmp_path / "target.npz")
    for folder in (ROOT / "tests" / "runtime", ROOT / "tests" / "cli"):
        monkeypatch.syspath_prepend(folder)
    monkeypatch.setitem(REGISTRIES.perception.builtin, "blind", "blind_plugins:Blind")
    monkeypatch.setitem(REGISTRIES.estimators.builtin, "toy", "toy_plugins:ToyEstimator")
    monkeypatch.setitem(REGISTRIES.controllers.builtin, "toy", "toy_plugins:ToyController")
    stop = threading.Event()
    firmware = Firmware(character("p3dx-sh"))
    with Emulator(firmware, PtyPort()) as emulator, MjpegServer() as server:
        site = Site(emulator, server, tmp_path)
        site.filming.set()
        thread = threading.Thread(target=site.film, args=(stop,), daemon=True)
        thread.start()
        yield site
        stop.set()
        thread.join()


@pytest.fixture
def run(site: Site, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """Return a function that runs the program; it gives exit code, summary and messages."""

    def call(*arguments: str, devices: bool = True) -> tuple[int, dict[str, object], str]:
        capfd.readouterr()
        command = ["visctrl", "run", "toy.yaml", "--json", "--quiet", "--out", "o"]
        monkeypatch.setattr(sys, "argv", [*command, *(site.devices if devices else ()), *arguments])
        with pytest.raises(SystemExit) as caught:
            main()
        out, err = capfd.readouterr()
        return int(caught.value.code or 0), json.loads(out) if out else {}, err

    return call


def test_a_run_over_the_whole_real_path(site: Site, run: Run) -> None:
    code, summary, messages = run("--set", "controller.drive_s=1.5")
    assert code == 0, messages
    assert summary["status"] == "reached"
    assert "true pose is not known" in str(summary["reason"])
    assert site.emulator.pose.y > 0.3
    assert site.emulator.velocity == (0.0, 0.0)
    assert not site.emulator.motors
    assert site.emulator.traffic.violations() == []


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("silent", "not reported for"),
        ("bumper", "a front bumper is pressed"),
        ("camera-frozen", "the camera has frozen"),
        ("camera-dropped", "stream"),
    ],
)
def test_fault_while_driving(site: Site, run: Run, fault: str, says: str) -> None:
    def happen() -> None:
        if fault == "camera-frozen":
            site.filming.clear()
        elif fault == "camera-dropped":
            site.server.drop()
        else:
            site.emulator.faults.switch_on(fault)

    watcher = site.when_at_speed(happen)
    code, summary, messages = run()
    watcher.join()
    assert code == 3
    assert summary["status"] == "fault"
    assert says in messages
    stood = site.emulator.standing_since
    assert stood is not None
    assert stood - site.began <= 0.6
    site.filming.set()
    site.server.restore()
    site.emulator.faults.switch_off(fault)
    code, _, messages = run("--set", "controller.drive_s=0.5")
    assert code == 0, messages
    assert site.emulator.traffic.violations() == []


@pytest.mark.parametrize(
    ("trouble", "code", "says"),
    [
        ("sigterm", 143, "stopped by SIGTERM"),
        ("sigint", 130, "stopped by Ctrl-C"),
        ("raise", 3, "toy trouble"),
        ("nan", 3, "not finite"),
    ],
)
def test_whatever_ends_a_run_the_robot_is_left_in_order(
    site: Site, run: Run, trouble: str, code: int, says: str
) -> None:
    options = ("controller.at_s=0.8", f"controller.trouble={trouble}")
    done, _, messages = run(*(word for option in options for word in ("--set", option)))
    assert done == code
    assert says in messages
    assert site.emulator.velocity == (0.0, 0.0)
    assert not site.emulator.motors
    commands = [str(command) for command in site.emulator.traffic.commands()]
    assert commands[-5:] == ["E_STOP", "VEL 0", "RVEL 0", "ENABLE 0", "CLOSE"]
    assert site.emulator.traffic.violations() == []


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["--port", "/dev/does-not-exist"], 3, "there is no such port"),
        (["--camera-url", "http://127.0.0.1:9/x.mjpg"], 3, "cannot be opened"),
        (["--target", "nothing.npz"], 2, "visctrl teach"),
        (["--target", "toy.yaml"], 2, "not a target view"),
        (["--set", "camera.width=320"], 2, "taken by camera 'small'"),
        (["--robot", "p3at"], 2, "--robot p3dx"),
        (["--set", "target.file=null"], 2, "visctrl teach"),
        (["--backend", "mock"], 2, "has no such device"),
    ],
)
def test_what_cannot_be_used(
    site: Site, run: Run, arguments: list[str], code: int, says: str
) -> None:
    done, _, messages = run(*arguments)
    assert done == code
    assert says in messages
    assert "Traceback" not in messages
    assert site.emulator.pose == (0.0, 0.0, 0.0)
    assert not site.emulator.motors


def test_camera_of_another_size_than_its_calibration(site: Site, run: Run) -> None:
    large = MODEL.resized(320, 240)
    (site.folder / "small.yaml").write_text(large.model_dump_json())
    TargetView(np.zeros((1, 240, 320), np.uint8), large).save(site.folder / "target.npz")
    code, _, messages = run()
    assert code == 3
    assert "it delivers 160x120" in messages
    assert site.emulator.traffic.commands() == []


# --- teaching --------------------------------------------------------------------------------


def test_teaching_while_something_moves(
    site: Site, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    command = ["visctrl", "teach", "toy.yaml", "-o", "new.npz", "--frames", "3", *site.devices]
    monkeypatch.setattr(sys, "argv", command)
    (site.folder / "target.npz").unlink()  # what a scenario names before it has been taught
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2
    assert "differs from the first" in capfd.readouterr().err
    assert not (site.folder / "new.npz").exists()
    assert site.emulator.traffic.violations() == []


def test_target_view_survives_its_file(tmp_path: Path) -> None:
    images = np.random.default_rng(0).integers(0, 255, (2, 120, 160), dtype=np.uint8)
    view = TargetView(images, MODEL, backend="pioneer", robot="p3dx", taken="2026-01-01")
    view.save(tmp_path / "a.npz")
    again = load_target(tmp_path / "a.npz")
    assert np.array_equal(again.images, images)
    assert (again.camera, again.taken, again.odometry) == (MODEL, "2026-01-01", None)
    assert [frame.sequence for frame in again.frames()] == [0, 1]


# --- everything at once ----------------------------------------------------------------------


@pytest.mark.sim
def test_taught_emulated_and_driven_by_separate_programs(tmp_path: Path) -> None:
    """Teach in simulation, emulate the robot in the same hall, drive it over a terminal."""
    width = ["--set", "camera.width=400"]
    start = ["0.2", "-1.5", "8"]
    visctrl = [sys.executable, "-m", "visctrl"]

    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*visctrl, *arguments],
            cwd=tmp_path, env=environment(), capture_output=True, text=True, timeout=200,
            check=False,
        )  # fmt: skip

    taught = call("teach", "--backend", "sim", "-o", "target.npz", *width)
    assert taught.returncode == 0, taught.stderr
    assert "every scheme" in taught.stdout
    emulator = subprocess.Popen(
        [*visctrl, "emulate-pioneer", "--width", "400", "--start", *start],
        cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert emulator.stdout is not None
        port, url = emulator.stdout.readline().strip(), emulator.stdout.readline().strip()
        done = call(
            *("run", "--backend", "pioneer", "--scheme", "trifocal", "--target", "target.npz"),
            *("--port", port, "--camera-url", url, "--quiet", *width),
        )
        assert done.returncode == 0, done.stderr
        emulator.terminate()
        _, messages = emulator.communicate(timeout=20)
    finally:
        emulator.kill()
    assert emulator.returncode == 0
    ended = json.loads(messages.splitlines()[-1])
    assert math.hypot(ended["camera"]["x_m"], ended["camera"]["y_m"]) < 0.02
    assert abs(ended["camera"]["phi_deg"]) < 1.0
    assert ended["violations"] == []


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200"}
