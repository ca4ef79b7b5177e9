"""What is found out about a target view, and what it is said to be good for."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from driving import room, target_frame
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from visctrl.cli.teach import judge
from visctrl.hal.types import Frame
from visctrl.perception.quality import Quality, assess, sharpness
from visctrl.robots.errors import InputError

Image = NDArray[np.uint8]
Change = Callable[[Image], Image]
NAME, WIDTH = "hypercatadioptric", 480
CAMERA = room(NAME, WIDTH).camera


def blurred(sigma: float) -> Change:
    return lambda image: np.asarray(cv2.GaussianBlur(image, None, sigma), np.uint8)


def scaled(gain: float, offset: float) -> Change:
    return lambda image: np.clip(gain * image.astype(float) + offset, 0, 255).astype(np.uint8)


def plain_but_for_a_corner(image: Image) -> Image:
    """Keep a wedge of 50 deg of the panorama; the rest is a white wall."""
    y, x = np.indices(image.shape)
    angle = np.degrees(np.arctan2(y - CAMERA.cy, x - CAMERA.cx))
    return np.where((angle > 10) & (angle < 60), image, 180).astype(np.uint8)


def same(image: Image) -> Image:
    return image


def quality(change: Change = same) -> Quality:
    frame = target_frame(NAME, WIDTH)
    assert frame.image is not None
    return assess([Frame(0.0, 0, change(frame.image))], CAMERA)


def verdicts(change: Change) -> tuple[list[bool], str]:
    """Return what is good of features, spread, sharpness and light, and all that is said."""
    findings = judge(quality(change))
    return [good for good, _, _ in findings], " | ".join(f"{a}: {b}" for _, a, b in findings)


@pytest.mark.parametrize(
    ("change", "good", "says"),
    [
        (same, [True, True, True, True], "every scheme, from 3.5 m"),
        (blurred(2.0), [True, True, False, True], "blurred: focus"),
        (blurred(8.0), [False, True, False, False], "too few to be recognised"),
        (scaled(0.25, 0.0), [False, True, True, False], "too dark"),
        (scaled(0.5, 170.0), [True, True, True, False], "too bright"),
        (scaled(0.02, 120.0), [False, True, True, False], "they may be noise"),
        (plain_but_for_a_corner, [True, False, True, True], "all in one corner"),
    ],
    ids=["good", "soft", "blurred", "dark", "bright", "plain", "corner"],
)
def test_verdict(change: Change, good: list[bool], says: str) -> None:
    found, text = verdicts(change)
    assert found == good, text
    assert says in text


def test_reach_shrinks_with_the_features() -> None:
    """The fewer features, the nearer the robot must begin; the words keep that order."""
    figures = quality()

    def reach(features: int) -> tuple[bool, str]:
        fewer = Quality(
            features, figures.pixels, figures.sectors, figures.visible,
            figures.sharpness, figures.mean, figures.contrast,
        )  # fmt: skip
        good, _, meaning = judge(fewer)[0]
        return good, meaning

    told = [reach(features) for features in (1000, 300, 100, 20)]
    assert [good for good, _ in told] == [True, True, False, False]
    words = ["from 3.5 m and more", "from about 1.5 m", "only from near by", "too few"]
    for (_, meaning), word in zip(told, words, strict=True):
        assert word in meaning


def test_sharpness_falls_with_blur() -> None:
    values = [quality(blurred(sigma)).sharpness for sigma in (0.3, 1.0, 2.0, 3.0)]
    assert values == sorted(values, reverse=True)
    assert values[1] > 0.55 > values[2]  # two pixels are visible


@settings(max_examples=15)
@given(st.floats(0.3, 1.0), st.floats(0.0, 60.0))
def test_sharpness_depends_on_neither_contrast_nor_brightness(gain: float, offset: float) -> None:
    image = np.random.default_rng(0).integers(20, 180, (120, 160)).astype(np.uint8)
    image = np.asarray(cv2.GaussianBlur(image, None, 1.5), np.uint8)
    field = np.full_like(image, 255)
    changed = scaled(gain, offset)(image)
    assert sharpness(changed, field) == pytest.approx(sharpness(image, field), abs=0.06)


def test_plain_picture_has_no_sharpness() -> None:
    plain = np.full((120, 160), 90, np.uint8)
    assert sharpness(plain, np.full_like(plain, 255)) == 0.0


def test_pictures_of_different_things_are_refused() -> None:
    frame = target_frame(NAME, WIDTH)
    other = Frame(0.1, 1, np.ascontiguousarray(np.asarray(frame.image)[:, ::-1]))
    with pytest.raises(InputError, match="differs from the first"):
        assess([frame, other], CAMERA)
