"""OpenCV's FileStorage in YAML, XML and JSON: pinhole, ``fisheye`` and ``omnidir``.

The names are those of OpenCV's own calibration programs and those that people give to what its
functions return (K, D, dist_coeffs). ``xi`` makes it `omnidir`, ``fisheye_model: 1`` `fisheye`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
import yaml
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.formats.distortions import (
    RADTAN_COUNTS,
    fisheye_fields,
    kind_of,
    omni_fields,
    pinhole_fields,
    radtan_of,
)
from visctrl.hal.cameras.formats.keys import EXTRA, Keys, camera_of, ours_of, unwritable
from visctrl.robots.errors import InputError

Array = NDArray[np.float64]

MATRIX = ("camera_matrix", "K", "intrinsic_matrix", "intrinsics", "mtx", "M")
DISTORTION = (
    *("distortion_coefficients", "dist_coeffs", "distortion_coeffs", "D", "dist"),
    *("distortion", "distortion_parameters", "coefficients"),
)
_MODEL = ("distortion_model", "camera_model", "model", "model_type")
#: What says nothing about the projection.
_HARMLESS = (
    *("calibration_time", "calibration_date", "date", "time", "comment", "camera_name", "name"),
    *("nr_of_frames", "nframes", "board_width", "board_height", "square_size", "marker_size"),
    *("aspect_ratio", "fix_aspect_ratio", "flags", "flag_value", "calibrate_zero_tangent_dist"),
    *("avg_reprojection_error", "per_view_reprojection_errors", "reprojection_error", "rms"),
    *("extrinsic_parameters", "image_points", "grid_points", "used_imgs", "rvecs", "tvecs"),
    *("std_deviations", "new_camera_matrix", "roi", "fps", "pattern", "board"),
)
#: Tangential coefficients beyond this are no lens': four numbers were a fisheye's.
_WIDEST_TANGENTIAL = 0.05


def recognises(data: Mapping[str, Any]) -> bool:
    """Return whether a mapping has a camera matrix by one of its names."""
    return any(isinstance(data.get(key), Mapping | list) for key in MATRIX)


def read(data: Mapping[str, Any], where: str, name: str) -> CentralCamera:
    """Return the camera of a file storage."""
    keys = Keys(data, where, loose=True)
    fields = matrix_fields(keys)
    fields |= _size(keys)
    kind = _kind(keys)
    fields |= _model(keys, kind)
    ours = keys.ours()
    keys.all_known(_HARMLESS)
    camera = camera_of(fields, ours, where, name)
    ambiguous = kind == "" and ours is None and camera.model == "pinhole-radtan"
    if ambiguous and len(keys.numbers(*DISTORTION)) == 4 and _suspicious(camera):
        raise InputError(
            f"{where}: key '{keys.find(*DISTORTION)}': these are no pinhole's coefficients: if the "
            "camera is a fisheye, say so with 'fisheye_model: 1'"
        )
    return camera


def matrix_fields(keys: Keys) -> dict[str, Any]:
    """Return fx, fy, cx, cy, skew of the camera matrix."""
    K = keys.numbers(*MATRIX, count=9)
    key = keys.find(*MATRIX)
    if [K[i] for i in (3, 6, 7, 8)] != [0.0, 0.0, 0.0, 1.0]:
        raise InputError(f"{keys.where}: key '{key}': expected a third row 0 0 1 and no K[1, 0]")
    for i, focal in ((0, "fx"), (4, "fy")):
        if K[i] == 0.0:
            raise InputError(f"{keys.where}: key '{key}': {focal} cannot be 0")
    return dict(zip(("fx", "skew", "cx", "fy", "cy"), K[[0, 1, 2, 4, 5]].tolist(), strict=True))


def write(camera: CentralCamera, suffix: str = ".yaml") -> str:
    """Return the text of a file storage: XML and JSON by those suffixes, else YAML.

    Raises
    ------
    InputError
        OpenCV has no such model.
    """
    content: dict[str, Any] = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_matrix": camera.K,
    }
    values = camera.coefficients
    radtan = radtan_of(camera)
    if camera.model == "unified":
        content |= {"distortion_coefficients": np.zeros((1, 4)), "xi": values["xi"]}
    elif camera.model == "unified-radtan":
        xi, *rest = values.values()
        content |= {"distortion_coefficients": np.array([rest]), "xi": xi}
    elif camera.model == "kannala-brandt":
        content |= {"fisheye_model": 1, "distortion_coefficients": np.array([[*values.values()]])}
    elif radtan is not None:
        content |= {"distortion_coefficients": np.array([radtan])}
    else:
        raise unwritable(camera, "OpenCV's format")
    content[EXTRA] = ours_of(camera)
    write_as = {".xml": _xml_text, ".json": _json_text}.get(suffix.lower(), _yaml_text)
    return write_as(content)


# --- reading -----------------------------------------------------------------------------------


def _size(keys: Keys) -> dict[str, int]:
    if keys.find("image_width", "width") is None and keys.find("image_size", "size") is not None:
        width, height = keys.lengths("image_size", "size", count=2)
        return {"width": width, "height": height}
    return {
        "width": keys.lengths("image_width", "width")[0],
        "height": keys.lengths("image_height", "height")[0],
    }


def _kind(keys: Keys) -> str:
    """Return what the file calls its model: fisheye, omni, radtan, rational; "" if it does not."""
    kind = ""
    if keys.find(*_MODEL) is not None:
        said = keys.text(*_MODEL)
        kind = "omni" if said.lower() in ("omni", "omnidir", "mei") else kind_of(said)
        if said.lower() in ("pinhole", "perspective"):
            kind = "radtan"
        if kind == "":
            raise InputError(
                f"{keys.where}: key '{keys.find(*_MODEL)}': unknown model '{said}'; known: "
                "pinhole, plumb_bob, rational_polynomial, fisheye, equidistant, omnidir"
            )
    if keys.find("fisheye_model") is not None:
        flag = keys.number("fisheye_model")
        if flag not in (0.0, 1.0):
            raise InputError(f"{keys.where}: key 'fisheye_model': expected 0 or 1 (got {flag:g})")
        said_so = "fisheye" if flag else "radtan"
        if kind not in ("", said_so):
            raise InputError(f"{keys.where}: key 'fisheye_model' says another model than '{kind}'")
        kind = said_so
    if keys.find("xi") is not None:
        if kind not in ("", "omni"):
            raise InputError(f"{keys.where}: key 'xi' does not go with a model of kind '{kind}'")
        kind = "omni"
    return kind


def _model(keys: Keys, kind: str) -> dict[str, Any]:
    if kind == "none" and keys.find(*DISTORTION) is None:
        return {"model": "unified", "xi": 0.0}
    counts = {"fisheye": (4,), "omni": (4, 5)}.get(kind, RADTAN_COUNTS)
    coefficients = keys.numbers(*DISTORTION, count=counts)
    at = f"{keys.where}: key '{keys.find(*DISTORTION)}'"
    if kind == "fisheye":
        return fisheye_fields(coefficients)
    if kind == "omni":
        return omni_fields(keys.number("xi"), coefficients, at)
    if kind == "none" and coefficients.any():
        raise InputError(f"{at}: has coefficients although its model is 'none'")
    return pinhole_fields(coefficients, at)


def _suspicious(camera: CentralCamera) -> bool:
    """Return whether a pinhole's coefficients are implausible: of another model, most likely."""
    values = camera.coefficients
    if max(abs(values["p1"]), abs(values["p2"])) > _WIDEST_TANGENTIAL:
        return True
    sides = [
        [x, y] for x in (0.0, camera.width - 1.0) for y in (camera.cy, 0.0, camera.height - 1.0)
    ]
    return not bool(np.isfinite(camera.unproject(sides)[0]).all())


# --- writing -----------------------------------------------------------------------------------


def _yaml_text(content: Mapping[str, Any]) -> str:
    lines = ["%YAML:1.0", "---"]
    for key, value in content.items():
        if isinstance(value, np.ndarray):
            rows, columns = value.shape
            data = ", ".join(map(_number_text, value.ravel()))
            lines += [f"{key}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}"]
            lines += ["   dt: d", f"   data: [ {data} ]"]
        elif isinstance(value, Mapping):
            lines += [f"{key}:", *(f"   {k}: {scalar_text(v)}" for k, v in value.items())]
        else:
            lines.append(f"{key}: {scalar_text(value)}")
    return "\n".join([*lines, ""])


def scalar_text(value: str | float) -> str:
    """Return a value as OpenCV's YAML has it: texts in quotes, floats with all their digits."""
    if isinstance(value, str):
        return yaml.safe_dump(value, default_style='"', width=10_000).strip()
    return str(value) if isinstance(value, int) else _number_text(value)


def _number_text(value: float) -> str:
    """Return a float with all its digits, so that YAML 1.1 takes it for one, too."""
    text = repr(float(value))
    return text if "." in text else text.replace("e", ".0e")


def _xml_text(content: Mapping[str, Any]) -> str:
    lines = ['<?xml version="1.0"?>', "<opencv_storage>"]
    for key, value in content.items():
        if isinstance(value, np.ndarray):
            rows, columns = value.shape
            data = " ".join(map(_number_text, value.ravel()))
            lines += [f'<{key} type_id="opencv-matrix">', f"  <rows>{rows}</rows>"]
            lines += [f"  <cols>{columns}</cols>", "  <dt>d</dt>"]
            lines += ["  <data>", f"    {data}</data></{key}>"]
        elif isinstance(value, Mapping):
            inner = [f"  <{k}>{_xml_scalar(v)}</{k}>" for k, v in value.items()]
            lines += [f"<{key}>", *inner, f"</{key}>"]
        else:
            lines.append(f"<{key}>{_xml_scalar(value)}</{key}>")
    return "\n".join([*lines, "</opencv_storage>", ""])


def _xml_scalar(value: str | float) -> str:
    if isinstance(value, str):
        return '"' + escape(value, {'"': "&quot;"}) + '"'
    return str(value) if isinstance(value, int) else _number_text(value)


def _json_text(content: Mapping[str, Any]) -> str:
    return json.dumps({key: _json_value(value) for key, value in content.items()}, indent=4) + "\n"


def _json_value(value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        return value
    data: Sequence[float] = value.ravel().tolist()
    rows, columns = value.shape
    return {"type_id": "opencv-matrix", "rows": rows, "cols": columns, "dt": "d", "data": data}
