from __future__ import annotations

import numpy as np
import pytest
from driving import START, room

from visctrl.hal.errors import InputError
from visctrl.hal.types import Features, Frame
from visctrl.perception.pictures import averaged, checked, draw
from visctrl.perception.unwrap import canvas_for

NAME, WIDTH = "hypercatadioptric", 400


@pytest.fixture(scope="module")
def canvas():
    return canvas_for(room(NAME, WIDTH).camera)


def image(**options):
    return room(NAME, WIDTH).frame(START, 3, **options).image


@pytest.mark.parametrize("gain", [0.5, 0.7, 1.3])
def test_exposure_is_taken_out(canvas, gain):
    reference, other = draw(image(), canvas).image, draw(image(gain=gain), canvas).image
    field = canvas.field > 0
    # What is clipped at white cannot come back; the middle of the range does.
    difference = np.abs(reference.astype(int) - other)[field]
    assert np.median(difference) <= (2 if gain < 1 else 6)


@pytest.mark.parametrize("noise", [0.0, 2.0, 8.0])
def test_darkness_is_blank_however_noisy(canvas, noise):
    shape = (room(NAME, WIDTH).camera.height, WIDTH)
    dark = np.random.default_rng(0).normal(6.0, noise, shape).clip(0, 255).astype(np.uint8)
    picture = draw(dark, canvas)
    assert picture.blank
    assert "is blank" in picture.complaint
    assert not draw(image(noise=noise), canvas).blank


def test_a_faint_scene_is_not_blank(canvas):
    assert not draw(image(gain=0.15), canvas).blank


def test_frames_of_another_kind_are_refused_by_name():
    camera = room(NAME, WIDTH).camera
    features = Features(np.arange(3), np.zeros((3, 2)))
    with pytest.raises(InputError, match="use the perception 'features'"):
        checked(Frame(0.0, 1, features=features), camera, "the target image")
    with pytest.raises(InputError, match="320x240, but camera 'hypercatadioptric' takes 400x300"):
        checked(Frame(0.0, 1, np.zeros((240, 320), np.uint8)), camera, "the target image")
    with pytest.raises(InputError, match="not an 8-bit grey image"):
        checked(Frame(0.0, 1, np.zeros((300, 400, 3), np.uint8)), camera, "the target image")


def test_averaging_takes_noise_out_and_refuses_another_pose(canvas):
    scene = room(NAME, WIDTH)
    clean = image().astype(float)
    noisy = [scene.frame(START, number, noise=10.0).image for number in range(1, 9)]
    field = clean > 0
    single, mean = (np.std((i - clean)[field]) for i in (noisy[0], averaged(noisy, canvas)))
    assert mean < 0.5 * single
    moved = scene.frame(START._replace(phi=0.0), 9).image
    with pytest.raises(InputError, match="image 3 of 3 differs from the first"):
        averaged([noisy[0], noisy[1], moved], canvas)
