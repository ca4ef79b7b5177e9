"""Calibrations of other programs: every model that a format can hold, and files that are wrong."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from tests.hal.camera_models import STRATEGIES
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.files import FORMATS, read_camera, write_camera
from visctrl.robots.errors import InputError

#: What each format can hold, of cameras without skew.
HOLDS = {
    "visctrl": set(STRATEGIES),
    "kalibr": set(STRATEGIES) - {"ocam"},
    "opencv": {"unified", "unified-radtan", "pinhole-radtan", "kannala-brandt"},
    "ros": {"pinhole-radtan", "kannala-brandt"},
    "camodocal": {"unified", "unified-radtan", "pinhole-radtan", "kannala-brandt"},
    "basalt": set(STRATEGIES) - {"ocam", "unified-radtan"},
    "ocamcalib": {"ocam"},
    "colmap": {"pinhole-radtan", "kannala-brandt"},
}
#: Formats without the terms beyond k1, k2, p1, p2 of a pinhole.
FOUR_TERMS = {"kalibr", "camodocal"}
PIXELS = np.stack(np.meshgrid(np.linspace(0, 639, 9), np.linspace(0, 479, 7)), axis=-1)
few = settings(max_examples=5, deadline=None, phases=[Phase.generate], derandomize=True)


def distortion(camera: CentralCamera) -> list[float]:
    """Return the coefficients without which a camera is of the unified model."""
    return [value for key, value in camera.coefficients.items() if key != "xi"]


def same_rays(a: CentralCamera, b: CentralCamera, tolerance: float) -> None:
    (rays, valid), (other, _) = a.unproject(PIXELS), b.unproject(PIXELS)
    assert valid.any()
    np.testing.assert_allclose(other[valid], rays[valid], atol=tolerance)


@pytest.mark.parametrize(
    ("form", "model"), [(form, model) for form in FORMATS for model in sorted(STRATEGIES)]
)
@given(data=st.data())
@few
def test_there_and_back(tmp_path_factory, form: str, model: str, data: st.DataObject) -> None:
    camera = data.draw(STRATEGIES[model])
    if model != "ocam":
        camera = camera.altered(skew=0.0)
    if model == "pinhole-radtan" and form in FOUR_TERMS:
        camera = camera.altered(k3=0.0, k4=0.0, k5=0.0, k6=0.0)
    if form == "ocamcalib" and model == "ocam":
        camera = camera.altered(affine=(1.0, *camera.affine[1:]))  # not mirrored
    path = tmp_path_factory.getbasetemp() / f"{form}-{model}.txt"
    if model not in HOLDS[form]:
        if camera.rectilinear:
            return
        with pytest.raises(InputError, match=r"cannot hold model|no skew"):
            write_camera(camera, path, form)
        return
    write_camera(camera, path, form)
    found = read_camera(path)
    same_rays(camera, found, 1e-9)
    assert (found.width, found.height) == (640, 480)
    if form not in ("basalt", "ocamcalib", "colmap"):
        assert found == camera or not any(distortion(camera))


@pytest.mark.parametrize("suffix", [".yaml", ".xml", ".json"])
@pytest.mark.parametrize("model", sorted(HOLDS["opencv"]))
@given(data=st.data())
@few
def test_opencv_reads_what_is_written(tmp_path_factory, suffix, model, data) -> None:
    camera = data.draw(STRATEGIES[model]).altered(name='a "name" & more')
    path = tmp_path_factory.getbasetemp() / f"{model}{suffix}"
    write_camera(camera, path, "opencv")
    assert read_camera(path) == camera or not any(distortion(camera))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    np.testing.assert_array_equal(storage.getNode("camera_matrix").mat(), camera.K)
    D = storage.getNode("distortion_coefficients").mat().ravel()
    values = distortion(camera)
    np.testing.assert_array_equal(D[: len(values)], values[: len(D)])


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
@pytest.mark.parametrize("key", ["distortion_coefficients", "dist_coeffs", "D"])
def test_what_opencv_writes_is_read_by_any_name(tmp_path: Path, suffix: str, key: str) -> None:
    path = tmp_path / f"file.{suffix}"
    K = np.array([[535.0, 0, 342], [0, 534, 235], [0, 0, 1]])
    D = np.array([[-0.266, -0.038, 0.0017, -0.00028, 0.23]])
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", 640), ("image_height", 480), ("camera_matrix", K)):
        storage.write(name, value)
    storage.write(key, D)
    storage.release()
    camera = read_camera(path)
    points = np.random.default_rng(0).uniform((-0.5, -0.4, 1), (0.5, 0.4, 1), (50, 3))
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, D)[0][:, 0]
    np.testing.assert_allclose(camera.project(points)[0], expected, atol=1e-8)


def text_file(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def opencv_yaml(K: list[float], D: list[float], *more: str) -> str:
    return "\n".join(
        [
            "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480",
            *more,
            f"camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: {K}",
            f"distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: {len(D)}\n   dt: d",
            f"   data: {D}\n",
        ]
    )


K = [300.5, 0.0, 321.25, 0.0, 301.0, 239.0, 0.0, 0.0, 1.0]
FISHEYE = "fisheye_model: 1"
FOCAL = [300.5, 301.0, 321.25, 239.0]


@pytest.mark.parametrize(
    ("kalibr", "opencv", "model"),
    [
        (("omni", [1.2, *FOCAL], "radtan", [-0.2, 0.05, 1e-3, -5e-4]), "xi: 1.2", "unified-radtan"),
        (("pinhole", FOCAL, "radtan", [-0.28, 0.07, 2e-4, 2e-5]), "", "pinhole-radtan"),
        (
            ("pinhole", FOCAL, "equidistant", [0.01, -2e-3, 1e-3, 0]),
            "fisheye_model: 1",
            "kannala-brandt",
        ),
        (("pinhole", FOCAL, "equidistant", [0.0] * 4), FISHEYE, "kannala-brandt"),
        (("pinhole", FOCAL, "radtan", [0.0] * 4), "", "unified"),
    ],
)
def test_kalibr_s_and_opencv_s_conventions_give_the_same_rays(
    tmp_path: Path, kalibr: tuple, opencv: str, model: str
) -> None:
    keys = ("camera_model", "intrinsics", "distortion_model", "distortion_coeffs")
    chain = {"cam0": {**dict(zip(keys, kalibr, strict=True)), "resolution": [640, 480]}}
    a = read_camera(text_file(tmp_path / "k.yaml", yaml.safe_dump(chain)))
    b = read_camera(text_file(tmp_path / "o.yaml", opencv_yaml(K, kalibr[3], opencv)))
    assert a.model == b.model == model
    same_rays(a, b, 1e-6)


def test_one_camera_of_a_stereo_chain(tmp_path: Path) -> None:
    part = {
        "camera_model": "ds",
        "intrinsics": [-0.2, 0.6, *FOCAL],
        "distortion_model": "none",
        "distortion_coeffs": [],
        "resolution": [640, 480],
        "rostopic": "/a",
    }
    other = {**part, "intrinsics": [0.6, 1.1, *FOCAL], "camera_model": "eucm"}
    other["T_cn_cnm1"] = np.eye(4).tolist()
    path = text_file(tmp_path / "chain.yaml", yaml.safe_dump({"cam0": part, "cam1": other}))
    assert read_camera(path, 0).model == "double-sphere"
    assert read_camera(path, 1).model == "extended-unified"


KB4 = {"k1": 0.01, "k2": -2e-3, "k3": 1e-3, "k4": 0.0}
KB4 |= dict(zip(("fx", "fy", "cx", "cy"), FOCAL, strict=True))
BASALT = {
    "value0": {
        "T_imu_cam": [{"px": 0.0}],
        "intrinsics": [{"camera_type": "kb4", "intrinsics": KB4}],
        "resolution": [[640, 480]],
    }
}
ROS = {
    "image_width": 640,
    "image_height": 480,
    "camera_name": "front",
    "camera_matrix": {"rows": 3, "cols": 3, "data": K},
    "distortion_model": "plumb_bob",
    "distortion_coefficients": {"rows": 1, "cols": 5, "data": [-0.2, 0.05, 1e-3, 0.0, 0.01]},
    "rectification_matrix": {"rows": 3, "cols": 3, "data": [1, 0, 0, 0, 1, 0, 0, 0, 1]},
    "projection_matrix": {"rows": 3, "cols": 4, "data": [0.0] * 12},
}
MEI = """%YAML:1.0
---
model_type: MEI
camera_name: camera
image_width: 640
image_height: 480
mirror_parameters:
   xi: 1.5
distortion_parameters:
   k1: -0.1
   k2: 0.02
   p1: 0.001
   p2: 0.0
projection_parameters:
   gamma1: 600.
   gamma2: 601.
   u0: 321.
   v0: 239.
"""
OCAM = """#polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB)

3 -1.0e+02 0.0 2.5e-03

#polynomial coefficients for the inverse mapping function (ocam_model.invpol in MATLAB)

5 1.999e+02 1.951e+02 8.9e+01 2.9e+01 5.0

#center: "row" and "column", starting from 0 (C convention)

239.2 320.9

#affine parameters "c", "d", "e"

1.0001 0.0002 -0.0003

#image size: "height" and "width"

480 640
"""
GOOD = {
    "basalt.json": json.dumps(BASALT, indent=2),
    "ros.yaml": yaml.safe_dump(ROS),
    "mei.yaml": MEI,
    "calib_results.txt": OCAM,
    "cameras.txt": "# Camera list\n1 OPENCV 640 480 300.5 301 321.75 239.5 -0.2 0.05 1e-3 0\n",
    "cv.yaml": opencv_yaml(K, [-0.2, 0.05, 1e-3, 0.0, 0.01]),
    "mine.yaml": yaml.safe_dump(load_camera("fisheye").model_dump(mode="json")),
}
files = pytest.mark.parametrize("name", sorted(GOOD))


@files
def test_they_are_recognised_by_what_they_say(tmp_path: Path, name: str) -> None:
    """Whatever their names end in."""
    camera = read_camera(text_file(tmp_path / "calibration", GOOD[name]))
    assert camera.unproject([camera.cx, camera.cy])[0] == pytest.approx([0, 0, 1], abs=2e-3)


def test_colmap_counts_from_the_corner_of_the_first_pixel(tmp_path: Path) -> None:
    a = read_camera(text_file(tmp_path / "a", GOOD["cameras.txt"]))
    assert (a.cx, a.cy) == (321.25, 239.0)


def test_ocamcalib_s_axes(tmp_path: Path) -> None:
    """A pixel to the right of the centre is seen to the right: x' of the file points down."""
    camera = read_camera(text_file(tmp_path / "o", OCAM))
    right, below = camera.unproject([[420.9, 239.2], [320.9, 339.2]])[0]
    # cam2world of the toolbox' C library, by hand, in its axes (down, right, backwards).
    assert right == pytest.approx(np.array([99.99, 0.02, 75.0]) / 125.0, abs=1e-3)
    assert below == pytest.approx(np.array([0.03, 99.99, 75.0]) / 125.0, abs=1e-3)


def refused(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_camera(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(path))
    return message


@files
@given(share=st.floats(0.0, 0.97))
@settings(max_examples=25, deadline=None, phases=[Phase.generate], derandomize=True)
def test_truncated_files_are_refused(tmp_path_factory, name: str, share: float) -> None:
    """Cut between lines, where the last line is whole, too."""
    text = GOOD[name]
    path = text_file(tmp_path_factory.getbasetemp() / name, text[: int(share * len(text))])
    try:
        camera = read_camera(path)
    except InputError as error:
        message = str(error)
    else:
        # Cut off was what does not say how rays become pixels.
        assert name in ("mine.yaml", "ros.yaml"), "nothing may be missed in silence"
        same_rays(camera, read_camera(text_file(path, text)), 1e-12)
        return
    if not message.startswith(str(path)) or (name != "mine.yaml" and "\n" in message):
        raise AssertionError(message)


@files
@given(data=st.data())
@settings(max_examples=20, deadline=None, phases=[Phase.generate], derandomize=True)
def test_a_key_too_few_is_named(tmp_path_factory, name: str, data: st.DataObject) -> None:
    if name in ("calib_results.txt", "cameras.txt", "mine.yaml"):
        return
    tree = json.loads(GOOD[name]) if name.endswith("json") else yaml.safe_load(plain(GOOD[name]))
    path, key, inner = data.draw(st.sampled_from(leaves(tree)))
    del inner[key]
    file = tmp_path_factory.getbasetemp() / f"few-{name}"
    file.write_text(json.dumps(tree))
    optional = ("T_imu_cam", "camera_name", "rectification_matrix", "projection_matrix", "px")
    optional += ("rows", "cols", "dt")  # numbers without them are counted by their key
    if key not in optional and "rectification" not in path and "projection_m" not in path:
        message = refused(file)
        assert key in message or "no calibration of a known format" in message, path


@files
@given(data=st.data())
@settings(max_examples=20, deadline=None, phases=[Phase.generate], derandomize=True)
def test_a_key_too_many_is_named(tmp_path_factory, name: str, data: st.DataObject) -> None:
    if name in ("calib_results.txt", "cameras.txt"):
        return
    tree = json.loads(GOOD[name]) if name.endswith("json") else yaml.safe_load(plain(GOOD[name]))
    top = tree.get("value0", tree)
    key = data.draw(st.sampled_from(["k9", "distortionx", "tilt_model", "thin_prism"]))
    top[key] = 0.5
    file = tmp_path_factory.getbasetemp() / f"many-{name}"
    file.write_text(json.dumps(tree))
    assert key in refused(file)


@files
@given(data=st.data(), bad=st.sampled_from([float("nan"), float("inf"), "many", [], None]))
@settings(max_examples=20, deadline=None, phases=[Phase.generate], derandomize=True)
def test_values_that_are_no_numbers_are_named(tmp_path_factory, name, data, bad) -> None:
    if name in ("calib_results.txt", "cameras.txt", "mine.yaml"):
        return
    tree = json.loads(GOOD[name]) if name.endswith("json") else yaml.safe_load(plain(GOOD[name]))
    numbers = [leaf for leaf in leaves(tree) if isinstance(leaf[2][leaf[1]], int | float | list)]
    ignored = ("rectification", "projection_matrix", "T_imu_cam")
    numbers = [leaf for leaf in numbers if not any(part in leaf[0] for part in ignored)]
    where, key, inner = data.draw(st.sampled_from(numbers))
    inner[key] = bad
    file = tmp_path_factory.getbasetemp() / f"bad-{name}"
    file.write_text(json.dumps(tree))
    if key in ("rows", "cols") and bad is None:
        return
    message = refused(file)
    named = (*where.split("."), "intrinsics", "no calibration")
    assert any(part in message for part in named if part), message


@pytest.mark.parametrize(
    ("name", "old", "new", "complaint"),
    [
        ("cv.yaml", "data: [-0.2, ", "data: [", "rows x cols = 5 numbers, found 4"),
        ("cv.yaml", "image_width: 640", "image_width: -3", "'image_width': expected positive"),
        ("cv.yaml", "image_width: 640", "image_width: 640\nfisheye_model: 1", "4 numbers, found 5"),
        ("cv.yaml", "---", "---\nD: [0, 0, 0, 0, 0]", "say the same twice"),
        ("cv.yaml", "---", "---\ndistortion_model: fisheye62", "unknown model 'fisheye62'"),
        ("ros.yaml", "plumb_bob", "equidistant", "expected 4 numbers, found 5"),
        ("ros.yaml", "plumb_bob", "thin_prism_fisheye", "distortion_model 'thin_prism_fisheye'"),
        ("mei.yaml", "MEI", "SCARAMUZZA", "model_type 'SCARAMUZZA'"),
        ("mei.yaml", "xi: 1.5", "xi: -1.5", "key 'xi'"),
        ("basalt.json", '"kb4"', '"ds"', "key 'xi' is missing"),
        ("basalt.json", '"kb4"', '"fov"', "camera_type 'fov'"),
        ("calib_results.txt", "3 -1.0e+02", "4 -1.0e+02", "says 4 coefficients, found 3"),
        ("calib_results.txt", "-1.0e+02", "1.0e+02", "polynomial"),
        ("calib_results.txt", "1.999e+02", "1.2e+03", "inverse mapping function"),
        ("calib_results.txt", "480 640", "480", "'image size': expected 2 numbers, found 1"),
        ("cameras.txt", "OPENCV", "FOV", "MODEL 'FOV'"),
        ("cameras.txt", "OPENCV", "FULL_OPENCV", "expected 12 numbers, found 8"),
        ("cameras.txt", "640 480", "640.5 480", "WIDTH HEIGHT"),
    ],
)
def test_contradictions_are_named(tmp_path: Path, name, old, new, complaint) -> None:
    assert old in GOOD[name]
    assert complaint in refused(text_file(tmp_path / name, GOOD[name].replace(old, new, 1)))


@pytest.mark.parametrize("D", [[0.1, 0.2, -0.3, 0.1], [-0.9, 0.2, 0.0, 0.0]])
def test_four_numbers_that_no_pinhole_has_are_not_taken_for_one(tmp_path: Path, D) -> None:
    message = refused(text_file(tmp_path / "K.yaml", opencv_yaml(K, D)))
    assert "fisheye_model: 1" in message


@pytest.mark.parametrize(
    "text", ["", "42", "[1, 2]", "a: b", "{", "<a/>", "<opencv_storage>", "# x"]
)
def test_files_that_are_no_calibration(tmp_path: Path, text: str) -> None:
    refused(text_file(tmp_path / "file", text))


def plain(text: str) -> str:
    return text.replace("%YAML:1.0", "").replace("!!opencv-matrix", "")


def leaves(tree: dict, above: str = "") -> list[tuple[str, str, dict]]:
    """Return (path, key, mapping) of every key of a tree, in lists of mappings, too."""
    found = []
    for key, value in tree.items():
        found.append((f"{above}.{key}", key, tree))
        for inner in value if isinstance(value, list) else [value]:
            if isinstance(inner, dict):
                found += leaves(inner, f"{above}.{key}")
    return found
