"""CamOdoCal's camera files (as VINS-Mono and VINS-Fusion use them): MEI, KANNALA_BRANDT, PINHOLE.

https://github.com/hengli/camodocal, ``src/camera_models``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.formats.distortions import (
    FISHEYE,
    RADTAN,
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
from visctrl.hal.cameras.formats.opencv import scalar_text
from visctrl.robots.errors import InputError

_WHAT = "CamOdoCal's format"
_PINHOLE = ("fx", "fy", "cx", "cy")
_MEI = ("gamma1", "gamma2", "u0", "v0")
_KB = ("k2", "k3", "k4", "k5", "mu", "mv", "u0", "v0")
_KNOWN = ("PINHOLE", "PINHOLE_FULL", "MEI", "KANNALA_BRANDT")
_HARMLESS = ("camera_name", "date", "comment")


def recognises(data: Mapping[str, Any]) -> bool:
    """Return whether a mapping has the parts of these files."""
    return "model_type" in data and "image_width" in data and "camera_matrix" not in data


def read(data: Mapping[str, Any], where: str, name: str) -> CentralCamera:
    """Return the camera of a file."""
    keys = Keys(data, where)
    kind = keys.text("model_type").upper()
    if kind not in _KNOWN:
        raise InputError(
            f"{where}: model_type '{kind}' is not one of: {', '.join(_KNOWN)}; for SCARAMUZZA give "
            "the toolbox' own calib_results.txt"
        )
    fields: dict[str, Any] = {
        "width": keys.lengths("image_width")[0],
        "height": keys.lengths("image_height")[0],
    }
    names = {"MEI": _MEI, "KANNALA_BRANDT": _KB}.get(kind, _PINHOLE)
    projection = _values(keys.within("projection_parameters"), names)
    *first, fx, fy, cx, cy = projection.values()
    fields |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    if kind == "KANNALA_BRANDT":
        fields |= {"model": "kannala-brandt", **dict(zip(FISHEYE, first, strict=True))}
    else:
        wanted = RADTAN if kind == "PINHOLE_FULL" else RADTAN[:4]
        part = keys.within("distortion_parameters")
        values = _values(part, wanted)
        if kind == "MEI":
            xi = _values(keys.within("mirror_parameters"), ("xi",))["xi"]
            fields |= omni_fields(xi, np.array([*values.values()]), part.where)
        else:
            fields |= pinhole_fields(np.array([values[key] for key in wanted]), part.where)
    ours = keys.ours()
    keys.all_known(_HARMLESS)
    return camera_of(fields, ours, f"{where}: key 'projection_parameters'", name)


def write(camera: CentralCamera) -> str:
    """Return the text of a file.

    Raises
    ------
    InputError
        CamOdoCal has no such model, or the camera has skew.
    """
    focal_and_centre = without_skew(camera, _WHAT)
    values = list(camera.coefficients.values())
    radtan = radtan_of(camera)
    parts: dict[str, dict[str, float]] = {}
    projection = dict(zip(_PINHOLE, focal_and_centre, strict=True))
    if radtan is not None and not any(radtan[4:]):
        kind = "PINHOLE"
        parts["distortion_parameters"] = dict(zip(RADTAN, radtan[:4], strict=False))
    elif camera.model in ("unified", "unified-radtan"):
        kind = "MEI"
        parts["mirror_parameters"] = {"xi": values[0]}
        distortion = values[1:] or [0.0] * 4
        parts["distortion_parameters"] = dict(zip(RADTAN, distortion, strict=False))
        projection = dict(zip(_MEI, focal_and_centre, strict=True))
    elif camera.model == "kannala-brandt":
        kind = "KANNALA_BRANDT"
        projection = dict(zip(_KB, [*values, *focal_and_centre], strict=True))
    else:
        raise unwritable(camera, _WHAT)
    parts["projection_parameters"] = projection
    lines = ["%YAML:1.0", "---", f"model_type: {kind}", f"camera_name: {scalar_text(camera.name)}"]
    lines += [f"image_width: {camera.width}", f"image_height: {camera.height}"]
    for part, content in parts.items():
        lines += [f"{part}:", *(f"   {key}: {scalar_text(v)}" for key, v in content.items())]
    lines += [f"{EXTRA}:", *(f"   {key}: {scalar_text(v)}" for key, v in ours_of(camera).items())]
    return "\n".join([*lines, ""])


def _values(keys: Keys, names: tuple[str, ...]) -> dict[str, float]:
    """Return the numbers of a part, all of them and no others."""
    found = {name: keys.number(name) for name in names}
    keys.all_known()
    return found
