"""(ξ, K) from boards: exact on exact corners, close on rendered images, clear on bad ones."""

from __future__ import annotations

import json
import sys

import cv2
import numpy as np
import pytest
from views import board_image, save

from visctrl.calibration.boards import Board, Corners
from visctrl.calibration.bundle import Bundle
from visctrl.calibration.camera import MISFIT_PX, BoardView, calibrate
from visctrl.cli.main import main
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.files import read_camera
from visctrl.hal.cameras.models.pinhole_radtan import PinholeRadtanCamera
from visctrl.reproduce.calibration import ray_errors_deg
from visctrl.robots.errors import InputError
from visctrl.sim.render.board_images import facing

BOARD = Board("checkerboard", 8, 6, 0.05)
CAMERAS = ("perspective", "hypercatadioptric", "paracatadioptric", "fisheye")


def shifted(name: str) -> CentralCamera:
    camera = load_camera(name)
    return camera.altered(cx=camera.cx + 4.6, cy=camera.cy + 16.2, fy=camera.fy * 1.01)


def exact_sights(camera: CentralCamera, count: int, noise: float, seed: int = 0) -> list[BoardView]:
    """Return boards all over the field of view, their corners projected, not found."""
    rng = np.random.default_rng(seed)
    low, high = np.radians([camera.min_polar_deg, camera.max_polar_deg])
    sights = []
    while len(sights) < count:
        polar, azimuth = rng.uniform(low, min(high, 2.0)), rng.uniform(-np.pi, np.pi)
        s = np.sin(polar)
        direction = np.array([s * np.cos(azimuth), s * np.sin(azimuth), np.cos(polar)])
        axes = facing(direction, rng.uniform(-np.pi, np.pi), tuple(rng.uniform(-0.6, 0.6, 2)))
        points = (BOARD.points - BOARD.points.mean(axis=0)) @ axes.T
        pixels, seen = camera.project(points + rng.uniform(0.25, 0.9) * direction)
        if seen.sum() >= 20:
            found = pixels[seen] + rng.normal(0.0, noise, (seen.sum(), 2))
            sights.append(BoardView(f"{len(sights)}.png", Corners(np.flatnonzero(seen), found)))
    return sights


@pytest.mark.parametrize("name", CAMERAS)
def test_exact_corners_give_the_exact_camera(name: str):
    camera = shifted(name)
    size = (camera.width, camera.height)
    found = calibrate(BOARD, exact_sights(camera, 8, 0.0), size, "auto", "found").camera
    for key in ("xi", "fx", "fy", "cx", "cy"):
        assert getattr(found, key) == pytest.approx(getattr(camera, key), rel=1e-6, abs=1e-6)


def test_standard_deviations_say_how_far_off_it_is():
    camera = shifted("hypercatadioptric")
    size = (camera.width, camera.height)
    ratios = []
    for seed in range(4):
        result = calibrate(BOARD, exact_sights(camera, 10, 0.1, seed), size, "omni", "found")
        true = np.array([camera.xi, camera.fx, camera.fy, camera.cx, camera.cy])
        ratios.append((result.fit.intrinsics - true) / result.fit.sigmas)
        assert result.fit.total_rms == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
    # 20 standard normal numbers, nearly: their rms lies in here but for once in some thousand.
    assert 0.45 < np.sqrt(np.mean(np.square(ratios))) < 1.65


def test_bad_images_are_named_and_left_out():
    camera = shifted("fisheye")
    sights = exact_sights(camera, 10, 0.05)
    for spoilt in (3, 7):
        corners = sights[spoilt].corners
        moved = corners.pixels + np.random.default_rng(1).normal(0.0, 2.0, corners.pixels.shape)
        sights[spoilt] = BoardView(sights[spoilt].name, Corners(corners.ids, moved))
    result = calibrate(BOARD, sights, (camera.width, camera.height), "omni", "found")
    assert result.bad == ("3.png", "7.png")
    assert all((result.rms[name] > 1.0) == (name in result.bad) for name in result.rms)
    good = [sight for sight in sights if sight.name not in result.bad]
    again = calibrate(BOARD, good, (camera.width, camera.height), "omni", "found")
    assert result.fit.intrinsics == pytest.approx(again.fit.intrinsics, rel=1e-5)


def test_single_corners_that_are_wrong_are_left_out():
    camera = shifted("paracatadioptric")
    size = (camera.width, camera.height)
    sights = exact_sights(camera, 8, 0.05)
    clean = calibrate(BOARD, sights, size, "omni", "found").fit.intrinsics
    for sight in sights:
        sight.corners.pixels[4] += (0.9, -0.6)
    result = calibrate(BOARD, sights, size, "omni", "found")
    assert result.corners_left_out == 8
    assert not result.bad
    assert result.fit.intrinsics == pytest.approx(clean, rel=1e-3)


def test_a_free_xi_is_used_only_where_it_explains_something():
    camera = shifted("perspective")
    sights = exact_sights(camera, 8, 0.1)
    result = calibrate(BOARD, sights, (camera.width, camera.height), "auto", "found")
    assert result.camera.xi == 0.0
    assert result.fit.sigmas[0] == 0.0
    assert abs(result.camera.fx / camera.fx - 1.0) < 0.005


def test_images_of_something_else_fit_no_camera():
    rng = np.random.default_rng(0)
    sights = [
        BoardView(f"{i}", Corners(np.arange(35), rng.uniform(0.0, 600.0, (35, 2))))
        for i in range(6)
    ]
    with pytest.raises(InputError, match="fit no central camera"):
        calibrate(BOARD, sights, (800, 600), "auto", "found")


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


def test_rendered_images_of_a_mirror_camera(visctrl, tmp_path):
    camera, rng = shifted("hypercatadioptric"), np.random.default_rng(4)
    views = [
        board_image(camera, BOARD, polar, 2.4 * k, 0.33, rng)
        for k, polar in enumerate(np.linspace(1.05, 1.7, 10))
    ]
    folder = save(tmp_path / "boards", views)
    cv2.imwrite(str(folder / "empty.png"), np.full((600, 800), 90, np.uint8))
    options = ("--size", "8x6", "--square", "0.05", "--axis", "down", "--polar", 45, 120)
    code, out, err = visctrl("calibrate", "camera", folder, *options, "-o", "my.yaml", "--json")
    assert code == 0, err
    report, found = json.loads(out), read_camera(tmp_path / "my.yaml")
    assert report["not_found"][0].endswith("empty.png")
    assert len(report["images"]) + len(report["not_found"]) == 11
    assert all((rms < 0.3) == (name not in report["bad"]) for name, rms in report["images"].items())
    assert report["rms_px"] < 0.1
    for key in ("fx", "fy"):
        assert abs(getattr(found, key) / getattr(camera, key) - 1.0) < 0.005
    assert ray_errors_deg(camera, found).max() < 0.1
    assert (found.optical_axis, found.min_polar_deg, found.max_polar_deg) == ("down", 45.0, 120.0)
    code, out, err = visctrl("calibrate", "convert", "my.yaml", "k.yaml", "--format", "kalibr")
    assert (code, read_camera(tmp_path / "k.yaml")) == (0, found)


def test_charuco_corners_are_found_where_they_are_even_in_part():
    camera, rng = load_camera("fisheye"), np.random.default_rng(0)
    board = Board("charuco", 6, 5, 0.07)
    image = board_image(camera, board, 0.5, 0.4, 0.45, rng)
    whole = board.find(image)
    assert whole is not None
    assert len(whole) == 20
    image[:, : int(np.quantile(whole.pixels[:, 0], 0.2))] = 110
    part = board.find(image)
    assert part is not None
    assert 10 <= len(part) < 20
    common, a, b = np.intersect1d(whole.ids, part.ids, return_indices=True)
    assert len(common) == len(part)
    apart = np.abs(whole.pixels[a] - part.pixels[b]).max(axis=1)
    assert np.quantile(apart, 0.8) < 0.1, "but for corners right at the cut"


def test_a_mirrored_picture_is_turned_round(visctrl, tmp_path):
    camera, rng = load_camera("fisheye").altered(cx=410.0), np.random.default_rng(2)
    board = Board("charuco", 6, 5, 0.07)
    polars = (0.2, 0.5, 0.8, 0.4, 0.7, 0.3)
    views = [
        board_image(camera, board, polar, 1.1 * k, 0.4, rng)[:, ::-1]
        for k, polar in enumerate(polars)
    ]
    folder = save(tmp_path / "boards", views)
    options = ("--board", "charuco", "--size", "6x5", "--square", "0.07")
    code, _, err = visctrl("calibrate", "camera", folder, *options, "--mirrored", "-o", "m.yaml")
    assert code == 0, err
    found = read_camera(tmp_path / "m.yaml")
    assert found.fx == pytest.approx(-450.0, rel=0.01)
    assert found.cx == pytest.approx(799 - 410.0, abs=1.0)
    code, _, err = visctrl("calibrate", "camera", folder, *options)
    assert code == 2, "markers cannot be read in a mirror"
    assert "view00.png: no charuco of 6x5 squares found" in err


def test_what_cannot_be_calibrated_is_said(visctrl, tmp_path):
    size = ("--size", "8x6", "--square", "0.05")
    blank = save(tmp_path / "blank", [np.full((300, 400), 90, np.uint8)] * 2)
    code, _, err = visctrl("calibrate", "camera", blank, *size)
    assert code == 2
    assert f"{blank}/view00.png: no checkerboard of 8x6 squares found here nor in the 1" in err
    cv2.imwrite(str(blank / "view02.png"), np.zeros((30, 40), np.uint8))
    code, _, err = visctrl("calibrate", "camera", blank, *size)
    assert (code, "view02.png: is 40x30" in err) == (2, True)
    code, _, err = visctrl("calibrate", "camera", "none.png", *size)
    assert (code, "none.png: no such image or folder" in err) == (2, True)
    code, _, err = visctrl("calibrate", "camera", blank, "--size", "8-6", "--square", "0.05")
    assert (code, "expected squares across x down" in err) == (2, True)
    code, _, err = visctrl("calibrate", "camera", blank, "--size", "2x6", "--square", "0.05")
    assert (code, "4 to 40" in err) == (2, True)
    code, _, err = visctrl("calibrate", "camera", blank, *size, "--format", "tum")
    assert (code, "expected one of visctrl, kalibr, opencv" in err) == (2, True)
    code, _, err = visctrl("calibrate", "convert", "fisheyes", "new.yaml")
    assert (code, "did you mean 'fisheye'" in err) == (2, True)
    code, _, err = visctrl("calibrate", "convert", "fisheye", "new.yaml", "--polar", 50, 20)
    assert (code, "min_polar_deg must be less" in err) == (2, True)
    views = [board_image(load_camera("fisheye"), BOARD, 0.3, 0.5, 0.4, np.random.default_rng(0))]
    folder = save(tmp_path / "one", views)
    code, _, err = visctrl("calibrate", "camera", folder, *size)
    assert (code, "found in 1 images, 4 are the least" in err) == (2, True)


def test_a_printed_board_is_found_in_its_own_picture(visctrl, tmp_path):
    for kind, size in (("checkerboard", "8x6"), ("charuco", "6x5")):
        options = ("--board", kind, "--size", size, "--square", "0.03", "--px", 60)
        code, out, err = visctrl("calibrate", "board", "board.png", *options)
        assert (code, "board.png" in out) == (0, True), err
        columns, rows = map(int, size.split("x"))
        picture = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
        found = Board(kind, columns, rows, 0.03).find(picture)
        assert found is not None
        assert len(found) == (columns - 1) * (rows - 1)
    code, _, err = visctrl("calibrate", "board", "board.xyz", *options)
    assert (code, "cannot be written" in err) == (2, True)


def test_the_same_view_again_is_no_evidence():
    camera = shifted("fisheye")
    (one,) = exact_sights(camera, 1, 0.0)
    rng = np.random.default_rng(2)
    again = [
        BoardView(f"{k}.png", Corners(one.corners.ids, one.corners.pixels + rng.normal(0, 0.2, 2)))
        for k in range(8)
    ]
    with pytest.raises(InputError, match=r"in 1 images \(7 more show it where"):
        calibrate(BOARD, again, (camera.width, camera.height), "auto", "found")


def test_distortion_that_the_model_has_not_is_in_the_deviations():
    """Never "± 0.1 px" for what is off by pixels."""
    lens = PinholeRadtanCamera(
        name="lens", width=640, height=480, cx=325.0, cy=236.0, fx=500.0, fy=501.0, k1=-0.05
    ).altered(max_polar_deg=34.0)
    bundle = Bundle(BOARD, [sight.corners for sight in exact_sights(lens, 8, 0.1)], pinhole=True)
    start = np.array([0.0, 500.0, 501.0, 325.0, 236.0])
    poses = bundle.start((640, 480))[0][2]
    found = bundle.fit(start, poses, robust=False)
    assert found.misfit_px > MISFIT_PX
    off = found.intrinsics[3:] - [325.0, 236.0]
    assert np.abs(off / found.sigmas[3:]).max() < 4.0


def test_a_model_that_fits_has_no_misfit():
    camera = shifted("hypercatadioptric")
    bundle = Bundle(BOARD, [s.corners for s in exact_sights(camera, 8, 0.3)], pinhole=False)
    start = np.array([camera.coefficients["xi"], *camera.K[[0, 1], [0, 1]], camera.cx, camera.cy])
    poses = bundle.start((800, 600))[0][2]
    assert bundle.fit(start, poses, robust=False).misfit_px < MISFIT_PX
