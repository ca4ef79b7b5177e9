"""ROS ``camera_info``: the YAML of camera_calibration, and an echoed CameraInfo message.

https://docs.ros.org/en/api/sensor_msgs/html/msg/CameraInfo.html
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import yaml

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.formats.distortions import (
    fisheye_fields,
    kind_of,
    pinhole_fields,
    radtan_of,
)
from visctrl.hal.cameras.formats.keys import EXTRA, Keys, camera_of, ours_of, unwritable
from visctrl.hal.cameras.formats.opencv import matrix_fields
from visctrl.robots.errors import InputError

_COUNTS = {"radtan": (4, 5), "rational": (8, 12, 14), "fisheye": (4,), "none": (0, 4, 5)}
_DISTORTION = ("distortion_coefficients", "D")
#: The rectification and the projection after it are of a pair, not of the camera.
_HARMLESS = (
    *("camera_name", "rectification_matrix", "projection_matrix", "R", "P", "header"),
    *("binning_x", "binning_y", "roi", "camera_serial", "date"),
)


def recognises(data: Mapping[str, Any]) -> bool:
    """Return whether a mapping has the keys of the file or of the message."""
    rectified = "projection_matrix" in data or "rectification_matrix" in data
    if "camera_matrix" in data:
        return rectified
    return "distortion_model" in data and ("K" in data or "k" in data) and "height" in data


def read(data: Mapping[str, Any], where: str, name: str) -> CentralCamera:
    """Return the camera of a ``camera_info``."""
    keys = Keys(data, where, loose=True)
    fields = matrix_fields(keys)
    fields["width"] = keys.lengths("image_width", "width")[0]
    fields["height"] = keys.lengths("image_height", "height")[0]
    said = keys.text("distortion_model")
    kind = kind_of(said)
    if kind == "":
        raise InputError(
            f"{where}: distortion_model '{said}' is not one of: plumb_bob, rational_polynomial, "
            "equidistant"
        )
    coefficients = keys.numbers(*_DISTORTION, count=_COUNTS[kind])
    at = f"{where}: key '{keys.find(*_DISTORTION)}'"
    if kind == "none" and coefficients.any():
        raise InputError(f"{at}: has coefficients although distortion_model is '{said}'")
    fields |= (
        fisheye_fields(coefficients) if kind == "fisheye" else pinhole_fields(coefficients, at)
    )
    _whole_picture(keys)
    ours = keys.ours()
    keys.all_known(_HARMLESS)
    return camera_of(fields, ours, where, name)


def distortion_of(camera: CentralCamera) -> tuple[str, list[float]] | None:
    """Return ``distortion_model`` and D of a camera, None if ROS has no name for its model."""
    radtan = radtan_of(camera)
    if radtan is not None:
        return ("plumb_bob" if len(radtan) == 5 else "rational_polynomial"), radtan
    if camera.model == "kannala-brandt":
        return "equidistant", list(camera.coefficients.values())
    return None


def write(camera: CentralCamera) -> str:
    """Return the text of a ``camera_info`` file.

    Raises
    ------
    InputError
        ROS has no such model.
    """
    found = distortion_of(camera)
    if found is None:
        raise unwritable(camera, "ROS' camera_info")
    model, D = found
    K = camera.K
    P = [[*row, 0.0] for row in K.tolist()]
    identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    content = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": camera.name,
        "camera_matrix": {"rows": 3, "cols": 3, "data": K.ravel().tolist()},
        "distortion_model": model,
        "distortion_coefficients": {"rows": 1, "cols": len(D), "data": D},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": identity},
        "projection_matrix": {"rows": 3, "cols": 4, "data": [x for row in P for x in row]},
        EXTRA: ours_of(camera),
    }
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def _whole_picture(keys: Keys) -> None:
    """Refuse binned pictures and parts: K is then not that of the pictures that come."""
    for key in ("binning_x", "binning_y"):
        if keys.find(key) is not None and keys.number(key) > 1.0:
            raise InputError(f"{keys.where}: key '{key}': calibrate the pictures as they come")
    if keys.find("roi") is not None:
        part = keys.within("roi")
        given = (key for key in ("x_offset", "y_offset", "width", "height") if part.find(key))
        if any(part.number(key) != 0.0 for key in given):
            raise InputError(f"{keys.where}: key 'roi': calibrate the pictures as they come")
