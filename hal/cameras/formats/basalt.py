"""Basalt's calibration (JSON): ds, eucm, kb4, ucm, pinhole, pinhole-radtan8.

https://gitlab.com/VladyslavUsenko/basalt-headers, ``calibration.hpp``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.formats.distortions import FISHEYE, RADTAN, pinhole_fields, radtan_of
from visctrl.hal.cameras.formats.keys import (
    EXTRA,
    Keys,
    camera_of,
    numbers,
    ours_of,
    unwritable,
    without_skew,
)
from visctrl.robots.errors import InputError

_WHAT = "Basalt's format"
_ROOT = "value0"
_K = ("fx", "fy", "cx", "cy")
_MODELS = {"ds": ("xi", "alpha"), "eucm": ("alpha", "beta"), "kb4": FISHEYE}
_NAMES = {"ds": "double-sphere", "eucm": "extended-unified", "kb4": "kannala-brandt"}
_RADTAN8 = "pinhole-radtan8"
_KNOWN = (*_MODELS, "ucm", "pinhole", _RADTAN8)
#: Of the inertial unit and of the pictures' brightness.
_HARMLESS = (
    *("T_imu_cam", "calib_accel_bias", "calib_gyro_bias", "imu_update_rate", "vignette"),
    *("accel_noise_std", "gyro_noise_std", "accel_bias_std", "gyro_bias_std"),
    *("cam_time_offset_ns", "T_mocap_world", "T_imu_marker", "mocap_time_offset_ns"),
    *("mocap_to_imu_offset_ns", "view_offset"),
)


def recognises(data: Mapping[str, Any]) -> bool:
    """Return whether a mapping has the root of these files."""
    return isinstance(data.get(_ROOT), Mapping)


def read(data: Mapping[str, Any], where: str, cam: int | None, name: str) -> CentralCamera:
    """Return camera number ``cam`` of a rig."""
    top = Keys(data, where)
    keys = top.within(_ROOT)
    top.all_known()
    cameras, sizes = keys.take("intrinsics"), keys.take("resolution")
    if not isinstance(cameras, list) or not cameras or not isinstance(sizes, list):
        raise InputError(f"{keys.where}: key 'intrinsics': expected a list of cameras")
    if len(sizes) != len(cameras):
        raise InputError(
            f"{keys.where}: key 'resolution': {len(sizes)} sizes for {len(cameras)} cameras"
        )
    if cam is None and len(cameras) > 1:
        raise InputError(f"{where}: holds {len(cameras)} cameras: say which with --cam N")
    if cam is not None and cam >= len(cameras):
        raise InputError(f"{where}: has no camera {cam}: it holds {len(cameras)}, from 0 on")
    which = cam or 0
    fields = _fields(Keys(cameras[which], f"{keys.where}: intrinsics.{which}"))
    size = Keys({"resolution": sizes[which]}, keys.where).lengths("resolution", count=2)
    ours = keys.ours()
    keys.all_known(_HARMLESS)
    fields["width"], fields["height"] = size
    reach = fields.pop("reach", 0.0)
    within = math.degrees(math.atan(reach)) if reach > 0.0 else 180.0
    return camera_of(fields, ours, f"{keys.where}: intrinsics.{which}", name, within_deg=within)


def write(camera: CentralCamera) -> str:
    """Return the text of a rig of one camera, at the inertial unit.

    Raises
    ------
    InputError
        Basalt has no such model, or the camera has skew.
    """
    K = dict(zip(_K, without_skew(camera, _WHAT), strict=True))
    values = camera.coefficients
    radtan = radtan_of(camera)
    if camera.model in _NAMES.values():
        kind = next(key for key, model in _NAMES.items() if model == camera.model)
        content = {**K, **values}
    elif camera.rectilinear:
        kind, content = "pinhole", K
    elif camera.model == "unified":
        # x/(z + ξ d) = (1 − α) x/((1 − α) z + α d)
        kind, alpha = "ucm", values["xi"] / (1.0 + values["xi"])
        focal = {key: K[key] * (1.0 - alpha) for key in ("fx", "fy")}
        content = {**K, **focal, "alpha": alpha}
    elif radtan is not None:
        kind = _RADTAN8
        content = {**K, **dict.fromkeys(RADTAN, 0.0), **values, "rpmax": 0.0}
    else:
        raise unwritable(camera, _WHAT)
    pose = {"px": 0.0, "py": 0.0, "pz": 0.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0}
    root = {
        "T_imu_cam": [pose],
        "intrinsics": [{"camera_type": kind, "intrinsics": content}],
        "resolution": [[camera.width, camera.height]],
        EXTRA: ours_of(camera),
    }
    return json.dumps({_ROOT: root}, indent=4, ensure_ascii=False) + "\n"


def _fields(camera: Keys) -> dict[str, Any]:
    """Return the model and its parameters; ``reach`` is the radius up to which it was fitted."""
    kind = camera.text("camera_type")
    if kind not in _KNOWN:
        raise InputError(f"{camera.where}: camera_type '{kind}' is not one of: {', '.join(_KNOWN)}")
    keys = camera.within("intrinsics")
    camera.all_known()
    names = {**_MODELS, "ucm": ("alpha",), _RADTAN8: RADTAN}.get(kind, ())
    fields: dict[str, Any] = {key: keys.number(key) for key in (*_K, *names)}
    if kind == _RADTAN8 and keys.find("rpmax") is not None:
        fields["reach"] = float(numbers(keys.take("rpmax"), f"{keys.where}: key 'rpmax'", 1)[0])
    keys.all_known()
    if kind in _NAMES:
        return {"model": _NAMES[kind], **fields}
    if kind == _RADTAN8:
        coefficients = np.array([fields.pop(key) for key in RADTAN])
        return {**fields, **pinhole_fields(coefficients, keys.where)}
    alpha = fields.pop("alpha", 0.0)
    if not 0.0 <= alpha < 1.0:
        raise InputError(f"{keys.where}: key 'alpha': expected 0 <= alpha < 1 (got {alpha:g})")
    focal = {key: fields[key] / (1.0 - alpha) for key in ("fx", "fy")}
    return {**fields, **focal, "model": "unified", "xi": alpha / (1.0 - alpha)}
