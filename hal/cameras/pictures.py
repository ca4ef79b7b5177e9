"""Pictures from files and bytes: read by this program, decoded by OpenCV.

OpenCV is never given a file's name: one that is not UTF-8 crashes it. Nor is it given a picture
whose size would fill the memory.
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visctrl.robots.errors import InputError
from visctrl.robots.files import read_bytes

Grey = NDArray[np.uint8]

_MOST_BYTES = 256_000_000
#: Pixels of a picture: four times those of the largest camera with a serious lens.
_MOST_PIXELS = 1 << 26


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

    width, height = _size(data, origin)
    if width * height > _MOST_PIXELS:
        raise InputError(
            f"{origin}: claims {width}x{height} pixels: more than {_MOST_PIXELS / 1e6:.0f} million "
            "are not read"
        )
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        image = None
    if image is None:
        raise InputError(f"{origin}: not a readable image")
    return np.asarray(image, dtype=np.uint8)


def _size(data: bytes, origin: str) -> tuple[int, int]:
    """Return width and height by the picture's head."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data)) as picture:
                size = picture.size
                # A part that claims gigabytes makes OpenCV ask for them.
                picture.verify()
                return size
    except Image.DecompressionBombError:
        raise InputError(f"{origin}: claims more pixels than are read") from None
    except Exception:
        # Readers of damaged heads fail in every way.
        raise InputError(f"{origin}: not a readable image") from None
