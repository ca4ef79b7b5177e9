"""Pinhole, fisheye and omnidirectional coefficients, as several formats share them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.models.pinhole_radtan import PinholeRadtanCamera
from visctrl.robots.errors import InputError

Array = NDArray[np.float64]

#: OpenCV's order; its longer vectors go on with thin prism and tilted sensor.
RADTAN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
RADTAN_COUNTS = (4, 5, 8, 12, 14)
FISHEYE = ("k1", "k2", "k3", "k4")
_FISHEYE_NAMES = ("equidistant", "equi", "fisheye", "kannalabrandt", "kannalabrandt4", "kb", "kb4")
_RADTAN_NAMES = ("radtan", "radialtangential", "plumbbob", "brown", "brownconrady")
_RATIONAL_NAMES = ("rationalpolynomial", "rational")
_NONE_NAMES = ("none", "")


def pinhole_fields(coefficients: Array, where: str) -> dict[str, Any]:
    """Return the model and its coefficients of a pinhole with OpenCV's vector.

    Raises
    ------
    InputError
        Thin prism or tilted sensor, which no model here has.
    """
    if coefficients[len(RADTAN) :].any():
        raise InputError(
            f"{where}: has thin prism or tilt coefficients, which are not supported: calibrate "
            "with 5 or 8 coefficients"
        )
    if not coefficients.any():
        return {"model": "unified", "xi": 0.0}
    return {"model": "pinhole-radtan", **dict(zip(RADTAN, coefficients.tolist(), strict=False))}


def fisheye_fields(coefficients: Array) -> dict[str, Any]:
    """Return the Kannala–Brandt model of its four coefficients."""
    return {"model": "kannala-brandt", **dict(zip(FISHEYE, coefficients.tolist(), strict=True))}


def omni_fields(xi: float, coefficients: Array, where: str) -> dict[str, Any]:
    """Return the unified model with the coefficients k1, k2, p1, p2.

    Raises
    ------
    InputError
        There are more, which the model has not.
    """
    if coefficients[4:].any():
        raise InputError(f"{where}: an omnidirectional camera has k1, k2, p1, p2 only")
    if not coefficients.any():
        return {"model": "unified", "xi": xi}
    named = dict(zip(RADTAN[:4], coefficients[:4].tolist(), strict=True))
    return {"model": "unified-radtan", "xi": xi, **named}


def kind_of(name: str) -> str:
    """Return what a distortion model's name means: radtan, rational, fisheye, none or ""."""
    plain = "".join(c for c in name.lower() if c.isalnum())
    kinds = {"fisheye": _FISHEYE_NAMES, "radtan": _RADTAN_NAMES, "rational": _RATIONAL_NAMES}
    for kind, names in (*kinds.items(), ("none", _NONE_NAMES)):
        if plain in names:
            return kind
    return ""


def radtan_of(camera: CentralCamera) -> list[float] | None:
    """Return the 5 or 8 radial–tangential coefficients of a pinhole, None for other models."""
    if isinstance(camera, PinholeRadtanCamera):
        values = list(camera.coefficients.values())
        return values if any(values[5:]) else values[:5]
    return [0.0] * 5 if camera.rectilinear else None
