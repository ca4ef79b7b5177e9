"""Photographs for textures, from the package mvtb-data (MIT licence), read when first wanted."""

from __future__ import annotations

from functools import lru_cache
from importlib import resources

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.hal.errors import InputError

Image = NDArray[np.uint8]

_PACKAGE = "mvtbdata"
#: Buildings, streets, rooms and plants, all larger than 400 px a side.
_NAMES = (
    "building2-1.png",
    "building2-3.png",
    "castle.png",
    "church.png",
    "flowers1.png",
    "flowers4.png",
    "flowers7.png",
    "flowers9.png",
    "lab-scene.png",
    "notre-dame.png",
    "parks.png",
    "road.png",
    "roof.png",
    "rocks2-l.png",
    "street.png",
    "walls-l.png",
    "wheres-wally.png",
)


def photograph(number: int) -> Image:
    """Return a grey photograph (rows, columns); the same number gives the same one.

    Raises
    ------
    InputError
        The package that holds them is not installed.
    """
    return _read(_NAMES[number % len(_NAMES)])


@lru_cache(maxsize=len(_NAMES))
def _read(name: str) -> Image:
    try:
        content = (resources.files(_PACKAGE) / "images" / name).read_bytes()
    except (ModuleNotFoundError, FileNotFoundError):
        raise InputError(
            "the pattern 'photo' needs photographs: pip install 'visctrl[scenes]'"
        ) from None
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE)
    return np.asarray(picture, dtype=np.uint8)
