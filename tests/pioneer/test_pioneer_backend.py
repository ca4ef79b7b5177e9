"""The backend: emulated robot and streamed camera, opened and released together."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from virtual_robot import Site

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.models.unified import UnifiedCamera
from visctrl.hal.errors import CameraError, InputError, LinkError
from visctrl.hal.interfaces import BackendSetup
from visctrl.hal.pioneer.backend import PioneerBackend, PioneerOptions
from visctrl.hal.types import Pose, Velocity
from visctrl.robots import load_robot

MODEL = UnifiedCamera(
    name="test", width=160, height=120, xi=0.0, fx=100.0, fy=100.0, cx=79.5, cy=59.5
)
MakeBench = Callable[..., Any]
CAMERA = "http://camera/stream.mjpg"


def backend(
    port: str, source: str, model: UnifiedCamera = MODEL, true: CentralCamera | None = None
) -> PioneerBackend:
    robot = load_robot("p3dx")
    options = PioneerOptions.model_validate({"port": port, "camera": {"source": source}})
    return PioneerBackend(
        BackendSetup(
            robot, robot.mount("centre"), model, true or model, Pose(0, 0, 0), None, options
        )
    )


def test_both_devices(bench: MakeBench, site: Site) -> None:
    it = bench()
    with backend(it.robot.url, CAMERA) as opened:
        assert opened.clock.lockstep is False
        frame = opened.camera.read()
        assert abs(opened.clock.now() - frame.stamp) < 0.3
        opened.base.command(Velocity(0.1, 0.0))
        assert opened.teach(3) == []
        assert opened.truth() is None
    opened.close()
    it.standstill_after(0.2)
    assert not it.robot.motors
    with pytest.raises(CameraError):
        opened.camera.read()


def test_missing_camera_leaves_the_robot_alone(bench: MakeBench) -> None:
    it = bench()
    with pytest.raises(CameraError), backend(it.robot.url, "97"):
        pass
    assert it.robot.traffic.commands() == []


def test_missing_robot_releases_the_camera(site: Site) -> None:
    lost = backend("/dev/does-not-exist", CAMERA)
    with pytest.raises(LinkError), lost:
        pass
    with pytest.raises(CameraError, match="not open"):
        lost.camera.read()


def test_camera_of_another_size(bench: MakeBench, site: Site) -> None:
    it = bench()
    with (
        pytest.raises(CameraError, match="160x120"),
        backend(it.robot.url, CAMERA, MODEL.altered(width=640, height=480)),
    ):
        pass
    assert it.robot.traffic.commands() == []


def test_true_camera_must_be_the_calibration() -> None:
    with pytest.raises(InputError, match="camera_error"):
        backend("/dev/null", "0", true=MODEL.altered(fx=101.0))
