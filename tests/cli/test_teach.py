"""`visctrl teach`, by a robot that stands before its target, on simulated time."""

from __future__ import annotations

import sys
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
from virtual_robot import Site

from visctrl.cli.main import main
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.emulator.emulator import Emulator
from visctrl.runtime.target_view import load_target

CAMERA = load_camera("perspective").resized(400, 300)
Teach = Callable[..., tuple[int, str, str]]


def textured() -> np.ndarray:
    """Blobs of all sizes."""
    chance = np.random.default_rng(3)
    image = np.full((CAMERA.height, CAMERA.width), 110, np.uint8)
    for _ in range(900):
        x, y = chance.uniform((0, 0), (CAMERA.width, CAMERA.height)).astype(int).tolist()
        level = int(chance.integers(0, 255))
        cv2.circle(image, (x, y), int(chance.integers(2, 12)), level, -1)
    return np.asarray(cv2.GaussianBlur(image, None, 0.6), np.uint8)


@pytest.fixture
def robot(site: Site) -> Emulator:
    site.film.size, site.film.scene = (CAMERA.width, CAMERA.height), textured()
    return site.robot()


@pytest.fixture
def teach(
    robot: Emulator,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> Teach:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    Path("mine.yaml").write_text(CAMERA.model_dump_json())

    def call(*options: str) -> tuple[int, str, str]:
        devices = ["--port", robot.url, "--camera-url", "http://camera/x", "--camera", "mine.yaml"]
        monkeypatch.setattr(sys, "argv", ["visctrl", "teach", *devices, *options])
        with pytest.raises(SystemExit) as caught:
            main()
        out, err = capfd.readouterr()
        return int(caught.value.code or 0), out, err

    return call


def test_view_is_taken_and_judged(robot: Emulator, teach: Teach) -> None:
    code, out, err = teach("-o", "here.npz", "--frames", "3", "--preview", "look.png")
    assert code == 0, err
    lines = out.splitlines()
    assert [line.split()[0] for line in lines] == ["ok", "ok", "ok", "ok", "ok", "files"]
    assert "every scheme" in lines[0]
    assert "arrival" in lines[4]
    assert "here.npz" in lines[-1]
    assert "look.png" in lines[-1]
    view = load_target(Path("here.npz"))
    assert view.camera == CAMERA
    assert view.images.shape == (3, CAMERA.height, CAMERA.width)
    assert len({image.tobytes() for image in view.images}) == 3  # three pictures, not one
    assert view.odometry == (0.0, 0.0, 0.0)
    assert (view.backend, view.robot) == ("pioneer", "p3dx")
    taken = datetime.fromisoformat(view.taken)
    assert abs(datetime.now(UTC) - taken.astimezone(UTC)) < timedelta(minutes=5)
    preview = cv2.imread("look.png")
    assert preview is not None
    assert (preview != preview[..., :1]).any()  # features are drawn in colour
    assert robot.pose == (0.0, 0.0, 0.0)
    assert not robot.motors


def test_warnings_of_a_poor_view(site: Site, teach: Teach) -> None:
    site.film.scene = np.asarray(cv2.GaussianBlur(textured(), None, 6.0) * 0.2, np.uint8)
    code, out, _ = teach()
    assert code == 0
    assert out.count("warning") >= 2
    assert "too dark" in out
    assert Path("target.npz").exists()
    assert Path("target.png").exists()


def test_camera_that_freezes(site: Site, teach: Teach) -> None:
    def freeze() -> None:
        site.wait_until(lambda: site.film.opened > 0)
        site.world.sleep(0.65)
        site.film.frozen = True

    site.meanwhile(freeze)
    code, _, err = teach("--frames", "50")
    assert code == 3
    assert "the camera has frozen" in err
    assert not Path("target.npz").exists()


def test_view_of_another_camera_is_refused(
    robot: Emulator,
    teach: Teach,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    assert teach()[0] == 0
    Path("mine.yaml").write_text(CAMERA.altered(fx=1.1 * CAMERA.fx).model_dump_json())
    before = robot.traffic.commands()
    command = ["visctrl", "run", "--backend", "pioneer", "--target", "target.npz"]
    devices = ["--port", robot.url, "--camera-url", "http://camera/x", "--camera", "mine.yaml"]
    monkeypatch.setattr(sys, "argv", [*command, *devices])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2
    assert "taken by camera" in capfd.readouterr().err
    assert robot.traffic.commands() == before
