"""COLMAP's ``cameras.txt``: one camera a line, CAMERA_ID MODEL WIDTH HEIGHT PARAMS[].

The upper left corner of the picture is its (0, 0), so the centre of the first pixel lies at
(0.5, 0.5). https://colmap.github.io/cameras.html
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.formats.distortions import (
    FISHEYE,
    RADTAN,
    fisheye_fields,
    pinhole_fields,
    radtan_of,
)
from visctrl.hal.cameras.formats.keys import camera_of, numbers, unwritable, without_skew
from visctrl.robots.errors import InputError

_WHAT = "COLMAP's format"
_F, _FXY = ("f", "cx", "cy"), ("fx", "fy", "cx", "cy")
_MODELS = {
    "SIMPLE_PINHOLE": _F,
    "PINHOLE": _FXY,
    "SIMPLE_RADIAL": (*_F, "k1"),
    "RADIAL": (*_F, "k1", "k2"),
    "OPENCV": (*_FXY, *RADTAN[:4]),
    "FULL_OPENCV": (*_FXY, *RADTAN),
    "SIMPLE_RADIAL_FISHEYE": (*_F, "k1"),
    "RADIAL_FISHEYE": (*_F, "k1", "k2"),
    "OPENCV_FISHEYE": (*_FXY, *FISHEYE),
}
_CORNER = 0.5


def recognises(text: str) -> bool:
    """Return whether a text has lines of cameras, or the comments that stand above them."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if lines and lines[0].startswith("#"):
        return re.search(r"camera list|CAMERA_ID", text, re.I) is not None
    return bool(lines) and re.match(r"\d+\s+[A-Z][A-Z_]+\s+\d", lines[0]) is not None


def read(text: str, where: str, cam: int | None, name: str) -> CentralCamera:
    """Return the camera with CAMERA_ID ``cam``, or the only one."""
    lines = [line.split() for line in text.splitlines() if line.strip() and line.strip()[0] != "#"]
    known = [line[0] for line in lines]
    if not lines:
        raise InputError(f"{where}: holds no camera")
    if cam is None and len(lines) > 1:
        raise InputError(f"{where}: holds {len(lines)} cameras: say which CAMERA_ID with --cam N")
    if cam is not None and known.count(str(cam)) != 1:
        raise InputError(f"{where}: has no CAMERA_ID {cam}: it holds {', '.join(known)}")
    line = lines[0] if cam is None else lines[known.index(str(cam))]
    at = f"{where}: camera {line[0]}"
    if len(line) < 4:
        raise InputError(f"{at}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]")
    model, size, values = line[1], line[2:4], line[4:]
    if model not in _MODELS:
        raise InputError(f"{at}: MODEL '{model}' is not one of: {', '.join(_MODELS)}")
    if not all(re.fullmatch(r"[1-9]\d*", side) for side in size):
        raise InputError(f"{at}: WIDTH HEIGHT: expected whole numbers (got {' '.join(size)})")
    names = _MODELS[model]
    found = dict(zip(names, numbers(values, f"{at}: PARAMS", len(names)).tolist(), strict=True))
    fields: dict[str, Any] = {
        "width": int(size[0]),
        "height": int(size[1]),
        "fx": found.get("fx", found.get("f")),
        "fy": found.get("fy", found.get("f")),
        "cx": found["cx"] - _CORNER,
        "cy": found["cy"] - _CORNER,
    }
    if "FISHEYE" in model:
        fields |= fisheye_fields(np.array([found.get(key, 0.0) for key in FISHEYE]))
    else:
        fields |= pinhole_fields(np.array([found.get(key, 0.0) for key in RADTAN]), at)
    return camera_of(fields, None, f"{at}: PARAMS", name)


def write(camera: CentralCamera) -> str:
    """Return the text of a file of one camera; it has no place for the mounting.

    Raises
    ------
    InputError
        COLMAP has no such model, or the camera has skew.
    """
    fx, fy, cx, cy = without_skew(camera, _WHAT)
    K = [fx, fy, cx + _CORNER, cy + _CORNER]
    radtan = radtan_of(camera)
    if camera.rectilinear:
        model, values = "PINHOLE", K
    elif camera.model == "kannala-brandt":
        model, values = "OPENCV_FISHEYE", [*K, *camera.coefficients.values()]
    elif radtan is not None and not any(radtan[4:]):
        model, values = "OPENCV", [*K, *radtan[:4]]
    elif radtan is not None:
        model, values = "FULL_OPENCV", [*K, *camera.coefficients.values()]
    else:
        raise unwritable(camera, _WHAT)
    line = " ".join(["1", model, str(camera.width), str(camera.height), *map(repr, values)])
    return f"# Camera list: CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n{line}\n"
