"""Pictures from files and bytes: read by this program, decoded by OpenCV.

OpenCV is never given a file's name: one that is not UTF-8 crashes it. Nor is it given a picture
whose size would fill the memory.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visctrl.robots.errors import InputError
from visctrl.robots.files import read_bytes

Grey = NDArray[np.uint8]

_MOST_BYTES = 256_000_000
#: Pixels of a picture: four times those of the largest camera with a serious lens.
_MOST_PIXELS = 1 << 26
#: TIFF's tag, and what undoes each of its values.
_ORIENTATION = 274
_TURN_BACK: dict[int, Callable[[NDArray[Any]], NDArray[Any]]] = {
    1: lambda image: image,
    2: np.fliplr,
    3: lambda image: np.rot90(image, 2),
    4: np.flipud,
    5: np.transpose,
    6: np.rot90,
    7: lambda image: np.rot90(image, 2).T,
    8: lambda image: np.rot90(image, -1),
}
#: Bits that sensors and files have.
_DEPTHS = (8, 10, 12, 14, 16, 24, 32)


def read_grey(path: Path) -> Grey:
    """Return a picture file in grey (height, width).

    Raises
    ------
    InputError
        It is missing, or no picture that can be used.
    """
    return decode_grey(read_bytes(path, _MOST_BYTES), str(path))


def decode_grey(data: bytes, origin: str) -> Grey:
    """Return a picture in grey (height, width); ``origin`` names it in messages.

    Raises
    ------
    InputError
        It is no picture, or one of too many pixels.
    """
    import cv2

    width, height, turned = _head(data, origin)
    if width * height > _MOST_PIXELS:
        raise InputError(
            f"{origin}: claims {width}x{height} pixels: more than {_MOST_PIXELS / 1e6:.0f} million "
            "are not read"
        )
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    # A tag that says how to hold the picture says nothing of where its pixels were taken.
    how = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), how)
    except cv2.error:
        image = None
    if image is None:
        raise InputError(f"{origin}: not a readable image")
    return eight_bit(_TURN_BACK[turned](np.asarray(image)), origin)


def eight_bit(image: NDArray[Any], origin: str) -> Grey:
    """Return a picture of any depth in 8 bits; ``origin`` names it in messages.

    Whole numbers are shifted by the bits beyond 8 that the picture uses, as 10 and 12 bits in a
    container of 16 do; fractions count from 0 to the least of 1, 255 and their greatest.

    Raises
    ------
    InputError
        It has values that are no brightness: negative, infinite or not a number.
    """
    image = np.ascontiguousarray(image)
    if image.dtype == np.uint8:
        return np.asarray(image, dtype=np.uint8)
    if not np.isfinite(image).all() or image.min() < 0:
        raise InputError(f"{origin}: has pixels that are negative or not finite")
    greatest = float(image.max())
    if np.issubdtype(image.dtype, np.integer):
        bits = next(bits for bits in _DEPTHS if greatest < 1 << bits)
        return np.asarray(image >> (bits - 8), dtype=np.uint8)
    full = next((full for full in (1.0, 255.0) if greatest <= full), greatest)
    return np.asarray(np.rint(image * (255.0 / full)), dtype=np.uint8)


def _head(data: bytes, origin: str) -> tuple[int, int, int]:
    """Return width, height, and the orientation that OpenCV applies whatever it is told."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data)) as picture:
                tags = getattr(picture, "tag_v2", {}) if picture.format == "TIFF" else {}
                turned = int(tags.get(_ORIENTATION, 1))
                size = picture.size
                # A part that claims gigabytes makes OpenCV ask for them.
                picture.verify()
                return (*size, turned if turned in _TURN_BACK else 1)
    except Image.DecompressionBombError:
        raise InputError(f"{origin}: claims more pixels than are read") from None
    except Exception:
        # Readers of damaged heads fail in every way.
        raise InputError(f"{origin}: not a readable image") from None
