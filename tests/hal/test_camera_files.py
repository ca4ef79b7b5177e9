"""Calibration files: there and back exactly, and as other programs read and write them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from visctrl.hal.cameras.catalogue import camera_names, load_camera
from visctrl.hal.cameras.files import read_camera, write_camera
from visctrl.hal.cameras.models.unified import UnifiedCamera
from visctrl.robots.errors import InputError

number = st.floats(-1e5, 1e5, allow_subnormal=False)
focal = st.floats(1e-8, 1e6) | st.floats(-1e6, -1e-8)
cameras = st.builds(
    UnifiedCamera,
    name=st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), max_size=20),
    width=st.integers(1, 10_000),
    height=st.integers(1, 10_000),
    xi=st.just(0.0) | st.floats(0.0, 5.0),
    fx=focal,
    fy=focal,
    cx=number,
    cy=number,
    skew=st.just(0.0) | number,
    optical_axis=st.sampled_from(["forward", "down", "up"]),
    yaw_deg=number,
    pitch_deg=number,
    roll_deg=number,
    min_polar_deg=st.floats(0.0, 80.0),
    max_polar_deg=st.floats(80.5, 180.0),
)


@pytest.mark.parametrize("form", ["visctrl", "kalibr", "opencv"])
@given(camera=cameras)
@settings(max_examples=60, deadline=None)
def test_there_and_back_is_exact(tmp_path_factory, form, camera):
    path = tmp_path_factory.getbasetemp() / f"{form}.yaml"
    if form == "kalibr" and camera.skew != 0.0:
        with pytest.raises(InputError, match="no skew"):
            write_camera(camera, path, form)
        return
    write_camera(camera, path, form)
    assert read_camera(path) == camera


@pytest.mark.parametrize("name", camera_names())
def test_opencv_reads_what_is_written(tmp_path: Path, name: str):
    camera = load_camera(name).altered(skew=0.1 + 0.2, cx=1 / 3)
    write_camera(camera, tmp_path / "camera.yaml", "opencv")
    storage = cv2.FileStorage(str(tmp_path / "camera.yaml"), cv2.FILE_STORAGE_READ)
    K = [[camera.fx, camera.skew, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    assert storage.getNode("camera_matrix").mat().tolist() == K
    assert storage.getNode("xi").real() == camera.xi
    assert storage.getNode("image_width").real() == camera.width
    assert storage.getNode("visctrl").getNode("optical_axis").string() == camera.optical_axis
    assert not storage.getNode("distortion_coefficients").mat().any()


def test_what_opencv_writes_is_read(tmp_path: Path):
    path = tmp_path / "from_opencv.yml"
    K = np.array([[411.7, 0.3, 399.123456789], [0.0, 409.25, 310.0], [0.0, 0.0, 1.0]])
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in (
        *(("image_width", 800), ("image_height", 600), ("camera_matrix", K)),
        *(("distortion_coefficients", np.zeros((1, 5))), ("xi", 1 / 3)),
    ):
        storage.write(key, value)
    storage.release()
    camera = read_camera(path)
    assert (camera.fx, camera.fy, camera.skew, camera.cx, camera.cy, camera.xi) == (
        *(411.7, 409.25, 0.3, 399.123456789, 310.0, 1 / 3),
    )
    assert (camera.name, camera.optical_axis) == ("from_opencv", "forward")
    corners = np.array([[0, 0], [799, 0], [0, 599], [799, 599]])
    assert camera.unproject(corners)[1].all(), "the whole picture is its field of view"


KALIBR = {
    "camera_model": "omni",
    "distortion_coeffs": [0.0, 0.0, 0.0, 0.0],
    "distortion_model": "radtan",
    "intrinsics": [1.2, 450.5, 451.5, 399.5, 299.5],
    "resolution": [800, 600],
    "rostopic": "/cam0/image_raw",
    "T_cam_imu": np.eye(4).tolist(),
}


def kalibr_file(path: Path, **changes: object) -> Path:
    path.write_text(yaml.safe_dump({"cam0": {**KALIBR, **changes}}))
    return path


def test_kalibr_files_are_read(tmp_path: Path):
    camera = read_camera(kalibr_file(tmp_path / "chain.yaml"))
    assert (camera.xi, camera.fx, camera.fy, camera.cx, camera.cy) == tuple(KALIBR["intrinsics"])
    assert (camera.width, camera.height) == (800, 600)
    changes = {"camera_model": "pinhole", "intrinsics": [600.0, 601.0, 320.0, 240.0]}
    pinhole = read_camera(kalibr_file(tmp_path / "chain.yaml", **changes))
    assert (pinhole.xi, pinhole.fx, pinhole.cy) == (0.0, 600.0, 240.0)


def test_kalibr_finds_what_it_looks_for(tmp_path: Path):
    write_camera(load_camera("hypercatadioptric"), tmp_path / "k.yaml", "kalibr")
    content = yaml.safe_load((tmp_path / "k.yaml").read_text())["cam0"]
    assert content["camera_model"] == "omni"
    assert content["intrinsics"] == [0.85, 117.0, 117.0, 399.5, 299.5]
    assert content["resolution"] == [800, 600]
    assert len(content["distortion_coeffs"]) == 4
    write_camera(load_camera("perspective"), tmp_path / "p.yaml", "kalibr")
    content = yaml.safe_load((tmp_path / "p.yaml").read_text())["cam0"]
    assert (content["camera_model"], len(content["intrinsics"])) == ("pinhole", 4)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"camera_model": "atan"}, "'atan' is not one of: pinhole, omni, ds, eucm"),
        ({"distortion_model": "fov"}, "distortion_model 'fov' is not one of"),
        ({"distortion_coeffs": [-0.2, 0.01, 0]}, "'distortion_coeffs': expected 4 numbers"),
        ({"distortion_parameters": [0.1]}, "'distortion_parameters' is not understood"),
        ({"intrinsics": [1.2, 450, 450, 400]}, "expected 5 numbers, found 4"),
        ({"intrinsics": "many"}, "expected numbers"),
        ({"resolution": None}, "'resolution' is missing"),
        ({"resolution": [800.5, 600]}, "'resolution': expected positive whole"),
        ({"distortion_model": None}, "'distortion_model' is missing"),
        ({"intrinsics": [float("nan"), 450, 450, 400, 300]}, "'intrinsics': expected finite"),
        ({"intrinsics": [1.2, 0.0, 450, 400, 300]}, "'intrinsics'.*cannot be 0"),
        ({"visctrl": {"optical_axis": "sideways"}}, "optical_axis"),
        ({"visctrl": 3}, "expected a mapping"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path: Path, changes, complaint):
    path = kalibr_file(tmp_path / "bad.yaml", **changes)
    with pytest.raises(InputError, match="bad.yaml.*" + complaint):
        read_camera(path)


def test_files_that_are_no_calibration(tmp_path: Path):
    with pytest.raises(InputError, match="no such file"):
        read_camera(tmp_path / "none.yaml")
    (tmp_path / "two.yaml").write_text(yaml.safe_dump({"cam0": KALIBR, "cam1": KALIBR}))
    with pytest.raises(InputError, match=r"2 cameras .*--cam"):
        read_camera(tmp_path / "two.yaml")
    with pytest.raises(InputError, match="no camera 2"):
        read_camera(tmp_path / "two.yaml", 2)
    (tmp_path / "short.yaml").write_text("%YAML:1.0\n---\nxi: 0.5\n")
    with pytest.raises(InputError, match="camera_matrix"):
        read_camera(tmp_path / "short.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="cannot be read"):
        read_camera(tmp_path / "binary.yaml")
    with pytest.raises(InputError, match="cannot be written"):
        write_camera(load_camera("fisheye"), tmp_path / "no" / "folder.yaml", "opencv")
