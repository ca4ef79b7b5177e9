"""Noise, blur and exposure of the simulated sensor."""

import numpy as np
import pytest
from numpy.typing import NDArray

from visctrl.sim.render.imaging import Sensor

GREY = np.full((200, 300), 128, np.uint8)


def sensor(
    noise: float = 0.0, blur_px: float = 0.0, exposure: float = 0.0, seed: int = 5
) -> Sensor:
    return Sensor(300, 200, noise, blur_px, exposure, seed)


def residual(picture: NDArray[np.uint8]) -> NDArray[np.float64]:
    return picture.astype(float) - 128.0


def test_a_perfect_sensor_changes_nothing() -> None:
    image = np.random.default_rng(0).integers(0, 256, GREY.shape).astype(np.uint8)
    assert np.array_equal(sensor().expose(image, 1.0, 1), image)


@pytest.mark.parametrize("sd", [0.8, 2.0, 10.0])
def test_noise_has_its_spread_and_no_bias(sd: float) -> None:
    picture = residual(sensor(noise=sd).expose(GREY, 0.0, 1))
    # Rounding to whole grey levels adds 1/12.
    assert picture.std() == pytest.approx(np.sqrt(sd**2 + 1 / 12), rel=0.03)
    assert abs(picture.mean()) < 4 * sd / np.sqrt(picture.size)


def test_noise_is_new_in_every_frame_and_the_same_for_the_same_one() -> None:
    one = sensor(noise=4.0)
    a, b = (residual(one.expose(GREY, 0.0, k)).ravel() for k in (1, 2))
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.02
    again = residual(sensor(noise=4.0).expose(GREY, 0.0, 1)).ravel()
    assert np.array_equal(a, again)
    other = residual(sensor(noise=4.0, seed=6).expose(GREY, 0.0, 1)).ravel()
    assert abs(np.corrcoef(a, other)[0, 1]) < 0.02


def test_noise_saturates() -> None:
    black = sensor(noise=20.0).expose(np.zeros_like(GREY), 0.0, 1)
    white = sensor(noise=20.0).expose(np.full_like(GREY, 255), 0.0, 1)
    assert black.max() < 128 < white.min()


def test_exposure_changes_slowly_within_its_amplitude() -> None:
    one = sensor(exposure=0.3)
    gains = np.array([one.gain(t) for t in np.arange(0.0, 30.0, 0.1)])
    assert gains.max() <= 1.3
    assert gains.min() >= 0.7
    assert np.ptp(gains) > 0.3
    assert np.abs(np.diff(gains)).max() < 0.3 * 0.1 * 2
    picture = one.expose(GREY, 4.0, 1)
    assert picture.mean() == pytest.approx(128 * one.gain(4.0), abs=0.6)


def test_blur_spreads_a_point_by_its_sigma() -> None:
    point = np.zeros_like(GREY)
    point[100, 150] = 255
    picture = sensor(blur_px=1.5).expose(point, 0.0, 1).astype(float)
    columns = np.arange(300) - 150
    spread = np.sqrt((picture.sum(axis=0) * columns**2).sum() / picture.sum())
    assert spread == pytest.approx(1.5, rel=0.1)
