"""``calib_results.txt`` of the OCamCalib toolbox (Scaramuzza), as its C library reads it.

The file's axes are row and column with z backwards; here they are column, row and z ahead. The
file's inverse polynomial is an approximation: the direct one is inverted instead, and a file
whose two polynomials contradict each other is refused.
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.formats.keys import camera_of, numbers, unwritable
from visctrl.hal.cameras.models.ocam import OcamCamera
from visctrl.robots.errors import InputError

Array = NDArray[np.float64]

#: Sections by a word of their comment; how many numbers each has, None for "count first".
_SECTIONS: dict[str, int | None] = {
    **{"direct": None, "inverse": None},
    **{"center": 2, "affine": 3, "image size": 2},
}
#: The two polynomials of a file may differ by this (px), in half of the picture.
_CONTRADICTION_PX = 5.0
_INVERSE_PX, _DEGREES = 0.01, range(5, 25)


def recognises(text: str) -> bool:
    """Return whether a text has the comments of the toolbox' file."""
    return re.search(r"^\s*#\s*polynomial coefficients", text, re.M | re.I) is not None


def read(text: str, where: str, name: str) -> CentralCamera:
    """Return the camera of a file."""
    found = _sections(text, where)
    direct, inverse = found["direct"], found["inverse"]
    c, d, e = found["affine"].tolist()
    row, column = found["center"].tolist()
    height, width = found["image size"].tolist()
    if not all(side > 0 and side == int(side) for side in (height, width)):
        raise InputError(f"{where}: image size: expected whole numbers of pixels")
    # row = c x' + d y', column = e x' + y', with x' = y and y' = x here.
    fields: dict[str, Any] = {
        "model": "ocam",
        "width": int(width),
        "height": int(height),
        "polynomial": (-direct).tolist(),
        "affine": (1.0, e, d, c),
        "cx": column,
        "cy": row,
    }
    camera = camera_of(fields, None, where, name)
    radius = np.linspace(0.05, 0.5, 10) * min(width, height)
    theta = np.arctan2(polynomial.polyval(radius, direct), radius)
    off = float(np.median(np.abs(polynomial.polyval(theta, inverse) - radius)))
    if not off <= _CONTRADICTION_PX:
        raise InputError(
            f"{where}: inverse mapping function: it differs by {off:.0f} px from the inverse of "
            "the direct one: the file is damaged"
        )
    return camera


def write(camera: CentralCamera) -> str:
    """Return the text of a file; it has no place for the mounting.

    Raises
    ------
    InputError
        The camera is of another model, or its picture is mirrored.
    """
    if not isinstance(camera, OcamCamera) or camera.affine[0] <= 0.0:
        raise unwritable(camera, "OCamCalib's format")
    uu, uv, vu, vv = camera.affine
    # The affine part has 1 in the file where uu is: the plane is scaled by it.
    direct = [-a * uu ** (1 - k) for k, a in enumerate(camera.polynomial)]
    lines = [
        "#polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB). "
        "These are used by cam2world",
        _counted(direct),
        "#polynomial coefficients for the inverse mapping function (ocam_model.invpol in MATLAB). "
        "These are used by world2cam",
        _counted(_inverse(np.array(direct), camera)),
        '#center: "row" and "column", starting from 0 (C convention)',
        f"{camera.cy!r} {camera.cx!r}",
        '#affine parameters "c", "d", "e"',
        f"{vv / uu!r} {vu / uu!r} {uv / uu!r}",
        '#image size: "height" and "width"',
        f"{camera.height} {camera.width}",
    ]
    return "\n\n".join(lines) + "\n"


def _sections(text: str, where: str) -> dict[str, Array]:
    """Return the numbers of every section."""
    found: dict[str, Array] = {}
    section = ""
    for line in text.splitlines():
        if line.lstrip().startswith("#"):
            said = line.lower()
            section = next((key for key in _SECTIONS if key in said), "")
            if section == "":
                raise InputError(f"{where}: section '{line.strip()}' is not understood")
        elif line.strip():
            at = f"{where}: section '{section}'"
            if section in found or section == "":
                raise InputError(f"{at}: more numbers than expected")
            values = numbers(line.split(), at)
            if _SECTIONS[section] is None:
                values = _uncounted(values, at)
            elif len(values) != _SECTIONS[section]:
                raise InputError(
                    f"{at}: expected {_SECTIONS[section]} numbers, found {len(values)}"
                )
            found[section] = values
    missing = [key for key in _SECTIONS if key not in found]
    if missing:
        raise InputError(f"{where}: section '{missing[0]}' is missing")
    return found


def _uncounted(values: Array, where: str) -> Array:
    if values[0] != len(values) - 1:
        raise InputError(f"{where}: says {values[0]:g} coefficients, found {len(values) - 1}")
    return values[1:]


def _inverse(direct: Array, camera: OcamCamera) -> Array:
    """Return the least polynomial ρ(θ) that inverts the direct one to a hundredth of a pixel.

    θ is the toolbox' angle, between the ray and the plane of the image.
    """
    farthest = math.hypot(camera.width, camera.height) * 0.6
    radius = np.linspace(0.0, farthest, 400)
    theta = np.arctan2(polynomial.polyval(radius, direct), radius)
    for degree in _DEGREES:
        fit = np.polynomial.Polynomial.fit(theta, radius, degree)
        if np.abs(fit(theta) - radius).max() < _INVERSE_PX:
            break
    return np.asarray(fit.convert().coef)


def _counted(values: Any) -> str:
    return " ".join([str(len(values)), *(repr(float(value)) for value in values)])
