"""Picture files of every kind and depth, read as the sensor took them."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from visctrl.hal.cameras.pictures import decode_grey
from visctrl.robots.errors import InputError
from visctrl.runtime.recording import image_files

#: Higher than wide, so that a turned picture has another shape.
SCENE = np.add.outer(np.arange(60), 2 * np.arange(40)).astype(np.uint8)


def encoded(image: Image.Image, form: str, **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, form, **options)
    return buffer.getvalue()


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("form", ["JPEG", "PNG", "TIFF", "WEBP"])
def test_orientation_tags_do_not_move_pixels(orientation: int, form: str) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    found = decode_grey(encoded(Image.fromarray(SCENE), form, exif=exif), "picture")
    plain = decode_grey(encoded(Image.fromarray(SCENE), form), "picture")
    np.testing.assert_array_equal(found, plain)
    assert np.abs(found.astype(int) - SCENE).max() < 8
    if form in ("PNG", "TIFF"):
        deep = Image.fromarray(SCENE.astype(np.uint16) * 256 + 255)
        np.testing.assert_array_equal(decode_grey(encoded(deep, form, exif=exif), "deep"), SCENE)


@pytest.mark.parametrize("bits", [10, 12, 16])
@pytest.mark.parametrize("form", ["PNG", "TIFF", "PPM"])
def test_more_bits_than_eight_keep_the_picture(bits: int, form: str) -> None:
    deep = SCENE.astype(np.uint16) * (1 << (bits - 8)) + 3
    deep[0, 0] = (1 << bits) - 1
    found = decode_grey(encoded(Image.fromarray(deep), form), "picture")
    np.testing.assert_array_equal(found[1:], SCENE[1:])


@pytest.mark.parametrize("full", [1.0, 255.0, 4000.0])
def test_fractions(full: float) -> None:
    image = SCENE / SCENE.max() * full
    found = decode_grey(encoded(Image.fromarray(image.astype(np.float32)), "TIFF"), "picture")
    expected = SCENE if full == 255.0 and SCENE.max() == 255 else SCENE / SCENE.max() * 255.0
    assert np.abs(found - expected).max() <= 1.0


def test_whole_numbers_of_32_bits() -> None:
    image = Image.fromarray(SCENE.astype(np.int32) * 16 + 5)
    np.testing.assert_array_equal(decode_grey(encoded(image, "TIFF"), "picture"), SCENE)


@pytest.mark.parametrize("form", ["GIF", "WEBP", "PPM", "BMP", "TIFF", "PNG"])
@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA"])
def test_forms_and_channels(form: str, mode: str) -> None:
    image = Image.fromarray(SCENE).convert(mode)
    if mode == "RGBA" and form in ("PPM", "GIF"):
        return
    options = {"lossless": True} if form == "WEBP" else {}
    found = decode_grey(encoded(image, form, **options), "picture")
    # WebP and GIF go through colours.
    assert np.abs(found.astype(int) - SCENE).max() <= 2


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_what_is_no_brightness_is_refused(bad: float) -> None:
    image = SCENE.astype(np.float32)
    image[3, 4] = bad
    with pytest.raises(InputError, match=r"shot\.tif: has pixels that are negative or not finite"):
        decode_grey(encoded(Image.fromarray(image), "TIFF"), "shot.tif")


def test_hidden_files_are_no_pictures(tmp_path: Path) -> None:
    for name in ("a2.png", "a10.webp", "._a2.png", ".hidden.jpg"):
        (tmp_path / name).write_bytes(b"")
    assert [path.name for path in image_files(tmp_path)] == ["a2.png", "a10.webp"]


def test_opencv_would_turn_the_tagged_picture() -> None:
    """The oracle of the first test: without the care taken the shape is another."""
    exif = Image.Exif()
    exif[0x0112] = 6
    data = encoded(Image.fromarray(SCENE), "JPEG", exif=exif)
    turned = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert turned.shape == SCENE.shape[::-1]
