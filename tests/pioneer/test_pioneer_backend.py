"""The backend: emulated robot and streamed camera, opened and released together."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
import pytest

from hal.central_camera import CentralCamera
from hal.errors import CameraError, InputError, LinkError
from hal.pioneer.backend import PioneerBackend, PioneerOptions
from hal.pioneer.emulator.stream import MjpegServer
from hal.types import Pose, Velocity
from robots import load_robot

pytestmark = pytest.mark.realtime
MODEL = CentralCamera(
    name="test", width=160, height=120, xi=0.0, fx=100.0, fy=100.0, cx=79.5, cy=59.5
)
MakeBench = Callable[..., Any]


@pytest.fixture
def stream() -> Iterator[str]:
    """A camera that sees noise."""
    rng = np.random.default_rng(0)
    stop = threading.Event()
    with MjpegServer() as server:

        def run() -> None:
            while not stop.wait(0.05):
                image = rng.integers(0, 255, (120, 160), dtype=np.uint8)
                server.publish(cv2.imencode(".jpg", image)[1].tobytes())

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        yield server.url
        stop.set()
        thread.join()


def backend(
    port: str, source: str, model: CentralCamera = MODEL, true: CentralCamera | None = None
) -> PioneerBackend:
    robot = load_robot("p3dx")
    options = PioneerOptions.model_validate({"port": port, "camera": {"source": source}})
    return PioneerBackend(
        robot, model, true or model, robot.mount("centre"), Pose(0, 0, 0), None, options, 0, False
    )


def test_both_devices(bench: MakeBench, stream: str) -> None:
    it = bench()
    with backend(it.emulator.url, stream) as opened:
        assert opened.clock.lockstep is False
        frame = opened.camera.read()
        assert abs(opened.clock.now() - frame.stamp) < 0.3
        opened.base.command(Velocity(0.1, 0.0))
        assert opened.teach(3) == []
        assert opened.truth() is None
    opened.close()
    it.standstill_after(0.2)
    assert not it.emulator.motors
    with pytest.raises(CameraError):
        opened.camera.read()


def test_missing_camera_leaves_the_robot_alone(bench: MakeBench) -> None:
    it = bench()
    with pytest.raises(CameraError), backend(it.emulator.url, "97"):
        pass
    assert it.emulator.traffic.commands() == []


def test_missing_robot_releases_the_camera(stream: str) -> None:
    lost = backend("/dev/does-not-exist", stream)
    with pytest.raises(LinkError), lost:
        pass
    with pytest.raises(CameraError, match="not open"):
        lost.camera.read()


def test_camera_of_another_size(bench: MakeBench, stream: str) -> None:
    it = bench()
    with (
        pytest.raises(CameraError, match="160x120"),
        backend(it.emulator.url, stream, MODEL.altered(width=640, height=480)),
    ):
        pass
    assert it.emulator.traffic.commands() == []


def test_true_camera_must_be_the_calibration() -> None:
    with pytest.raises(InputError, match="camera_error"):
        backend("/dev/null", "0", true=MODEL.altered(fx=101.0))
