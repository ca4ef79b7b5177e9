"""Calibrations as files: this project's YAML, Kalibr's and OpenCV's.

All three put the centre of the first pixel at (0, 0), and Kalibr's ``omni`` and OpenCV's
``omnidir`` are the unified model (1.6), (1.7) as it is here. What those formats do not know
(how the camera sits on the robot, which part of the picture is valid) is kept beside, under
``visctrl``, which other readers pass over. Numbers survive the way there and back exactly.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray

from visctrl.hal.cameras.catalogue import parse_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.models.unified import UnifiedCamera
from visctrl.robots.documents import parse_yaml
from visctrl.robots.errors import InputError
from visctrl.robots.files import read_text, write_text, writing
from visctrl.robots.plain_yaml import MOST_BYTES

Format = Literal["visctrl", "kalibr", "opencv"]
FORMATS: tuple[Format, ...] = ("visctrl", "kalibr", "opencv")

#: What other formats have no place for.
_OURS = (
    *("name", "optical_axis", "yaw_deg", "pitch_deg", "roll_deg"),
    *("min_polar_deg", "max_polar_deg"),
)
_EXTRA = "visctrl"


def read_camera(path: Path) -> CentralCamera:
    """Read a calibration of any of the three formats.

    Where the file does not say how the camera is mounted, it looks ahead, and its field of view
    is all that its model sees in the picture.

    Raises
    ------
    InputError
        The file is missing or not a calibration, or has what the central model has not (lens
        distortion, another model); the message names the file and the key.
    """
    text = read_text(path, MOST_BYTES)
    if text.lstrip().startswith("%YAML:1.0") or "!!opencv-matrix" in text:
        return _from_opencv(parse_yaml(_as_plain_yaml(text), str(path)), path)
    data = parse_yaml(text, str(path))
    if any(re.fullmatch(r"cam\d+", str(key)) for key in data):
        return _from_kalibr(data, path)
    return parse_camera(data, str(path))


def write_camera(camera: CentralCamera, path: Path, form: Format) -> None:
    """Write a calibration.

    Raises
    ------
    InputError, DiskError
        The format cannot hold this camera, or the file cannot be written.
    """
    text = {"visctrl": _plain_text, "kalibr": _kalibr_text, "opencv": _opencv_text}[form](camera)
    with writing(path):
        write_text(path, text)


# --- writing -------------------------------------------------------------------------------


def _plain_text(camera: CentralCamera) -> str:
    return yaml.safe_dump(camera.model_dump(mode="json"), sort_keys=False, allow_unicode=True)


def _unified(camera: CentralCamera, form: str) -> UnifiedCamera:
    if not isinstance(camera, UnifiedCamera):
        raise InputError(f"camera '{camera.name}': model '{camera.model}' has no place in {form}")
    return camera


def _kalibr_text(camera: CentralCamera) -> str:
    camera = _unified(camera, "Kalibr's format")
    if camera.skew != 0.0:
        raise InputError(
            f"camera '{camera.name}': Kalibr's format has no skew (here {camera.skew:g})"
        )
    K = [camera.fx, camera.fy, camera.cx, camera.cy]
    content = {
        "camera_model": "omni" if camera.xi > 0.0 else "pinhole",
        "intrinsics": [camera.xi, *K] if camera.xi > 0.0 else K,
        "distortion_model": "radtan",
        "distortion_coeffs": [0.0, 0.0, 0.0, 0.0],
        "resolution": [camera.width, camera.height],
        _EXTRA: _ours(camera),
    }
    return yaml.safe_dump({"cam0": content}, sort_keys=False, allow_unicode=True)


def _opencv_text(camera: CentralCamera) -> str:
    camera = _unified(camera, "OpenCV's format")
    K = (camera.fx, camera.skew, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0)
    ours = "\n".join(
        f"   {key}: {_quoted(value) if isinstance(value, str) else _number(value)}"
        for key, value in _ours(camera).items()
    )
    return "\n".join(
        [
            "%YAML:1.0",
            "---",
            f"image_width: {camera.width}",
            f"image_height: {camera.height}",
            _matrix("camera_matrix", 3, 3, K),
            _matrix("distortion_coefficients", 1, 4, (0.0,) * 4),
            f"xi: {_number(camera.xi)}",
            f"{_EXTRA}:",
            ours,
            "",
        ]
    )


def _matrix(name: str, rows: int, columns: int, values: Sequence[float]) -> str:
    data = ", ".join(map(_number, values))
    return (
        f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n"
        f"   data: [ {data} ]"
    )


def _number(value: float) -> str:
    """Return a float with all its digits, so that YAML 1.1 takes it for one, too."""
    text = repr(float(value))
    return text if "." in text else text.replace("e", ".0e")


def _quoted(text: str) -> str:
    return yaml.safe_dump(text, default_style='"', width=10_000).strip()


def _ours(camera: CentralCamera) -> dict[str, Any]:
    return {key: getattr(camera, key) for key in _OURS}


# --- reading -------------------------------------------------------------------------------


def _from_kalibr(data: Mapping[str, Any], path: Path) -> CentralCamera:
    cameras = sorted(key for key in data if re.fullmatch(r"cam\d+", str(key)))
    if len(cameras) > 1:
        raise InputError(f"{path}: holds {len(cameras)} cameras: leave only the one to use")
    key = cameras[0]
    content = data[key]
    if not isinstance(content, dict):
        raise InputError(f"{path}: key '{key}': expected a mapping of keys")
    where = f"{path}: {key}"
    _undistorted(_numbers(content, "distortion_coeffs", where, default=()), where)
    model = content.get("camera_model")
    if model not in ("omni", "pinhole"):
        raise InputError(f"{where}: camera_model '{model}' is not one of: omni, pinhole")
    count = 5 if model == "omni" else 4
    intrinsics = _numbers(content, "intrinsics", where, count=count)
    xi, fx, fy, cx, cy = intrinsics if model == "omni" else (0.0, *intrinsics)
    width, height = _numbers(content, "resolution", where, count=2)
    known = {"width": width, "height": height, "xi": xi, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    return _camera(known, content, path)


def _from_opencv(data: Mapping[str, Any], path: Path) -> CentralCamera:
    where = str(path)
    _undistorted(_numbers(data, "distortion_coefficients", where, default=()), where)
    K = _numbers(data, "camera_matrix", where, count=9)
    lower = [K[i] for i in (3, 6, 7, 8)]
    if lower != [0.0, 0.0, 0.0, 1.0]:
        raise InputError(f"{where}: key 'camera_matrix': expected a third row 0 0 1 and no K[1, 0]")
    known = {
        "width": _numbers(data, "image_width", where, count=1)[0],
        "height": _numbers(data, "image_height", where, count=1)[0],
        "xi": _numbers(data, "xi", where, default=(0.0,), count=1)[0],
        **{"fx": K[0], "skew": K[1], "cx": K[2], "fy": K[4], "cy": K[5]},
    }
    return _camera(known, data, path)


def _camera(known: Mapping[str, float], content: Mapping[str, Any], path: Path) -> CentralCamera:
    """Return a camera from its intrinsics and what the file says under our own key, if it does."""
    extra = content.get(_EXTRA)
    if extra is not None:
        if not isinstance(extra, dict):
            raise InputError(f"{path}: key '{_EXTRA}': expected a mapping of keys")
        return parse_camera({**extra, **known}, str(path))
    everything = {"name": path.stem, "max_polar_deg": 180.0, **known}
    camera = parse_camera(everything, str(path))
    return camera.altered(max_polar_deg=camera.widest_polar_deg)


def _undistorted(coefficients: NDArray[np.float64], where: str) -> None:
    if np.any(coefficients != 0.0):
        listed = ", ".join(f"{value:g}" for value in coefficients)
        raise InputError(
            f"{where}: the camera has lens distortion ({listed}), which the central model has not: "
            "calibrate it with `visctrl calibrate camera`, or undistort its images"
        )


def _numbers(
    data: Mapping[str, Any],
    key: str,
    where: str,
    *,
    count: int | None = None,
    default: Sequence[float] | None = None,
) -> NDArray[np.float64]:
    """Return a number, a list of numbers or a matrix as an array (N,)."""
    found = data.get(key, default)
    if found is None:
        raise InputError(f"{where}: key '{key}' is missing")
    if isinstance(found, dict):
        found = found.get("data", found)
    try:
        values = np.asarray(found, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        raise InputError(f"{where}: key '{key}': expected numbers (got {found!r})") from None
    if count is not None and len(values) != count:
        raise InputError(f"{where}: key '{key}': expected {count} numbers, found {len(values)}")
    return values


def _as_plain_yaml(text: str) -> str:
    """Return OpenCV's dialect as YAML: its header and its tags are none."""
    return re.sub(r"^\s*%YAML:1\.0\s*\n", "", text).replace("!!opencv-matrix", "")
