"""Kalibr's camera chains, and the flat ``sensor.yaml`` of the EuRoC data sets.

https://github.com/ethz-asl/kalibr/wiki/yaml-formats
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import yaml

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.formats.distortions import (
    fisheye_fields,
    kind_of,
    omni_fields,
    pinhole_fields,
    radtan_of,
)
from visctrl.hal.cameras.formats.keys import (
    EXTRA,
    Keys,
    camera_of,
    ours_of,
    unwritable,
    without_skew,
)
from visctrl.robots.errors import InputError

_WHAT = "Kalibr's format"
_HARMLESS = (
    *("rostopic", "cam_overlaps", "T_cn_cnm1", "T_cam_imu", "T_imu_cam", "timeshift_cam_imu"),
    *("sensor_type", "comment", "T_BS", "rate_hz", "line_delay"),
)
#: Parameters before the focal lengths.
_FIRST = {"pinhole": (), "omni": ("xi",), "ds": ("xi", "alpha"), "eucm": ("alpha", "beta")}
_MODELS = {"ds": "double-sphere", "eucm": "extended-unified"}


def recognises(data: Mapping[str, Any]) -> bool:
    """Return whether a mapping is a chain: its own, or its parts', keys say so."""
    return bool(_cameras(data)) or any(re.fullmatch(r"cam\d+", str(key)) for key in data)


def read(data: Mapping[str, Any], where: str, cam: int | None, name: str) -> CentralCamera:
    """Return camera number ``cam`` of a chain."""
    found = _cameras(data) or {key: data[key] for key in data if re.fullmatch(r"cam\d+", str(key))}
    if cam is None and len(found) > 1:
        raise InputError(
            f"{where}: holds {len(found)} cameras ({', '.join(found)}): say which with --cam N"
        )
    if cam is not None and cam >= len(found):
        raise InputError(f"{where}: has no camera {cam}: it holds {', '.join(found) or 'none'}")
    part = list(found)[cam or 0]
    others = [key for key in data if key not in found and data is not found[part]]
    if others:
        raise InputError(f"{where}: key '{others[0]}' is not understood beside cameras")
    return _one(found[part], f"{where}: {part}" if part else where, name)


def write(camera: CentralCamera) -> str:
    """Return the text of a chain of one camera.

    Raises
    ------
    InputError
        Kalibr has no such model, or the camera has skew.
    """
    fx, fy, cx, cy = without_skew(camera, _WHAT)
    values = camera.coefficients
    distortion, coefficients = "radtan", [0.0] * 4
    radtan = radtan_of(camera)
    if radtan is not None and not any(radtan[4:]):
        model, first, coefficients = "pinhole", [], radtan[:4]
    elif camera.model == "unified":
        model, first = "omni", [values["xi"]]
    elif camera.model == "unified-radtan":
        model, first = "omni", [values["xi"]]
        coefficients = list(values.values())[1:]
    elif camera.model == "kannala-brandt":
        model, first, distortion, coefficients = "pinhole", [], "equidistant", [*values.values()]
    elif camera.model in _MODELS.values():
        model = next(key for key, value in _MODELS.items() if value == camera.model)
        first, distortion, coefficients = list(values.values()), "none", []
    else:
        raise unwritable(camera, _WHAT)
    content = {
        "camera_model": model,
        "intrinsics": [*first, fx, fy, cx, cy],
        "distortion_model": distortion,
        "distortion_coeffs": coefficients,
        "resolution": [camera.width, camera.height],
        EXTRA: ours_of(camera),
    }
    return yaml.safe_dump({"cam0": content}, sort_keys=False, allow_unicode=True)


def _cameras(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the cameras of a chain by key; the whole, under "", if it is one camera itself."""
    if "camera_model" in data and "intrinsics" in data and "model_type" not in data:
        return {"": data}
    parts = {str(k): v for k, v in data.items() if isinstance(v, Mapping) and "camera_model" in v}
    return dict(sorted(parts.items(), key=lambda item: (len(item[0]), item[0])))


def _one(content: object, where: str, name: str) -> CentralCamera:
    keys = Keys(content, where)
    model = keys.text("camera_model")
    if model not in _FIRST:
        raise InputError(f"{where}: camera_model '{model}' is not one of: {', '.join(_FIRST)}")
    first = _FIRST[model]
    names = (*first, "fx", "fy", "cx", "cy")
    values = keys.numbers("intrinsics", count=len(names)).tolist()
    fields = dict(zip(names, values, strict=True))
    fields |= _distortion(keys, model, fields)
    fields["width"], fields["height"] = keys.lengths("resolution", count=2)
    ours = keys.ours()
    keys.all_known(_HARMLESS)
    return camera_of(fields, ours, f"{where}: key 'intrinsics'", name)


def _distortion(keys: Keys, model: str, fields: Mapping[str, float]) -> dict[str, Any]:
    """Return the model with what the distortion adds to it."""
    where, plain = keys.where, model in _MODELS
    said = keys.text("distortion_model", default="none" if plain else None)
    kind = kind_of(said)
    if kind == "" or kind == "rational":
        raise InputError(
            f"{where}: distortion_model '{said}' is not one of: radtan, equidistant, none"
        )
    given = ("distortion_coeffs", "distortion_coefficients")
    if kind == "none":
        if keys.find(*given) is not None:
            keys.numbers(*given, count=0)
        if model == "omni":
            return {"model": "unified"}
        return {"model": _MODELS[model]} if plain else {"model": "unified", "xi": 0.0}
    coefficients = keys.numbers(*given, count=4)
    at = f"{where}: key '{keys.find(*given)}'"
    if model == "omni" and kind == "radtan":
        return omni_fields(fields["xi"], coefficients, at)
    if model == "pinhole":
        radtan = kind == "radtan"
        return pinhole_fields(coefficients, at) if radtan else fisheye_fields(coefficients)
    if plain and not coefficients.any():
        return {"model": _MODELS[model]}
    raise InputError(f"{where}: camera_model '{model}' with distortion_model '{said}' is not known")
