"""The centre where vertical lines meet: on drawn lines, on rendered rooms, or a complaint."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from views import save

from visctrl.calibration.centre import find_centre
from visctrl.calibration.edges import find_segments
from visctrl.cli.main import main
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.files import read_camera
from visctrl.hal.types import Pose
from visctrl.robots.errors import InputError
from visctrl.sim.render.board_images import photographed
from visctrl.sim.render.renderer import BulletRenderer
from visctrl.sim.world.scene import load_scene

SIZE = (800, 600)


def star(centre: tuple[float, float], bars: int, rng: np.random.Generator) -> np.ndarray:
    """Return radial bars about a point, and as many straight edges that go anywhere."""
    image = np.full(SIZE[::-1], 90.0)
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]].astype(float)
    radius = np.hypot(u - centre[0], v - centre[1])
    bearing = np.arctan2(v - centre[1], u - centre[0])
    for k in range(bars):
        middle = 2 * np.pi * k / bars + rng.uniform(-0.1, 0.1)
        off = np.abs(np.angle(np.exp(1j * (bearing - middle)))) - 0.06
        inner = rng.uniform(70, 140)
        along = (radius > inner) & (radius < inner + rng.uniform(40, 120))
        image += 90.0 * along * np.clip(0.5 - off * radius, 0.0, 1.0)
    for _ in range(bars):
        a = rng.uniform(100, 500, 2)
        b = a + rng.uniform(-120, 120, 2)
        ends = [tuple(int(x) for x in p) for p in (a, b)]
        cv2.line(image, *ends, 200.0, 5, cv2.LINE_AA)
    return photographed(np.clip(image, 0, 255).astype(np.uint8), 0.7, 3.0, rng)


def texture(rng: np.random.Generator) -> np.ndarray:
    """Return a picture full of structure, none of it straight."""
    sizes = (4, 8, 16, 32, 64)
    layers = [
        k**0.7 * cv2.resize(rng.normal(0, 1, (600 // k, 800 // k)), SIZE, interpolation=2)
        for k in sizes
    ]
    return np.clip(128 + 12 * sum(layers), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("seed", range(2))
def test_radial_lines_among_others_give_their_centre(seed: int):
    rng = np.random.default_rng(seed)
    true = (404.0 + rng.uniform(-9, 9), 316.0 + rng.uniform(-9, 9))
    found = find_centre(find_segments(star(true, 12, rng)), SIZE, seed)
    assert np.abs(found.point - true).max() < 0.3
    assert (np.abs(found.point - true) / found.sigmas).max() < 4.0


@pytest.mark.parametrize("seed", range(2))
def test_texture_has_no_centre(seed: int):
    segments = find_segments(texture(np.random.default_rng(seed)))
    assert len(segments) > 20
    with pytest.raises(InputError, match="no vertical lines"):
        find_centre(segments, SIZE, seed)


def test_parallel_lines_meet_nowhere():
    image = np.full(SIZE[::-1], 90, np.uint8)
    for k in range(-6, 7):
        cv2.rectangle(image, (400 + 50 * k, 60), (420 + 50 * k, 450), 200, -1)
    with pytest.raises(InputError, match="no vertical lines"):
        find_centre(find_segments(image), SIZE, 0)


@pytest.fixture
def visctrl(monkeypatch, capfd, tmp_path):
    """Return a function that runs the program and returns exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> tuple[int, str, str]:
        capfd.readouterr()
        monkeypatch.setattr(sys, "argv", ["visctrl", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
        return int(caught.value.code or 0), *capfd.readouterr()

    return call


@pytest.mark.sim
def test_rendered_images_of_the_hall(visctrl, tmp_path: Path):
    camera = load_camera("hypercatadioptric").resized(1024, 768).altered(cx=541.0, cy=405.0)
    renderer, rng = BulletRenderer(load_scene("hall"), camera), np.random.default_rng(3)
    poses = [Pose(0.5, -1.0, 0.2), Pose(-0.8, -2.5, 1.5), Pose(0.0, 0.0, -2.0)]
    images = [photographed(renderer.render(pose, 0.7), 0.5, 2.0, rng) for pose in poses]
    renderer.close()
    folder = save(tmp_path / "hall", images)
    known = tmp_path / "known.yaml"
    code, _, err = visctrl("calibrate", "convert", "hypercatadioptric", known)
    assert code == 0, err
    code, _, err = visctrl("calibrate", "center", folder, "--camera", known)
    assert (code, "view00.png: is 1024x768, but camera" in err) == (2, True)
    code, out, err = visctrl("calibrate", "center", folder, "--json")
    assert code == 0, err
    report = json.loads(out)
    assert abs(report["cx"] - 541.0) < 1.0
    assert abs(report["cy"] - 405.0) < 1.0
    assert sum(image["lines"] for image in report["images"].values()) == report["lines"]


def test_the_new_centre_is_written_into_the_calibration(visctrl, tmp_path: Path):
    rng = np.random.default_rng(1)
    folder = save(tmp_path / "stars", [star((410.0, 305.0), 12, rng) for _ in range(3)])
    camera = ("--camera", "hypercatadioptric")
    code, out, err = visctrl("calibrate", "center", folder, *camera, "-o", "new.yaml")
    assert code == 0, err
    assert "camera 'hypercatadioptric' had (399.50, 299.50): +10." in out
    found = read_camera(tmp_path / "new.yaml")
    assert (found.cx, found.cy) == (pytest.approx(410.0, abs=0.3), pytest.approx(305.0, abs=0.3))
    assert found.altered(cx=399.5, cy=299.5) == load_camera("hypercatadioptric")


def test_scenes_without_lines_are_named(visctrl, tmp_path: Path):
    plain = save(tmp_path / "plain", [np.full((600, 800), 90, np.uint8)])
    code, _, err = visctrl("calibrate", "center", plain)
    assert (code, f"{plain}/view00.png: no vertical lines" in err) == (2, True)
    (plain / "view01.png").write_text("no image")
    code, _, err = visctrl("calibrate", "center", plain)
    assert (code, "view01.png: not a readable image" in err) == (2, True)
    code, _, err = visctrl("calibrate", "center", plain / "view00.png", "-o", "new.yaml")
    assert (code, "--camera" in err) == (2, True)
    (tmp_path / "nothing").mkdir()
    code, _, err = visctrl("calibrate", "center", tmp_path / "nothing")
    assert (code, "no images here" in err) == (2, True)
