"""Scale of a path: unbiased by the noise of what is seen, and by an unknown delay."""

import math

import numpy as np
import pytest

from visctrl.hal.types import Velocity
from visctrl.robots import load_robot
from visctrl.robots.unicycle import step_exact
from visctrl.schemes.path_scale import DeadReckoning, PathScale


def test_noise_does_not_bias_the_scale():
    """Thirty metres of scale seen over 0.3 m of path, with noise as large as the path."""
    rng, scales = np.random.default_rng(0), []
    for _ in range(200):
        scale = PathScale()
        for k in range(30):
            path = np.array([0.0, 0.01 * k])
            scale.update(path, np.array([0.0, 0.1]), path / 30.0 + 2e-3 * rng.normal(size=2), 2e-3)
        scales.append(1.0 / scale.estimate()[0])
    assert np.mean(scales) == pytest.approx(1.0 / 30.0, rel=0.05)


def test_delay_is_told_from_scale():
    scale = PathScale()
    for k in range(40):
        t, delay = 0.1 * k, 0.2
        driven, truly = (0.05 * max(s, 0.0) ** 2 for s in (t, t - delay))
        path, velocity = np.array([0.0, driven]), np.array([0.0, 0.1 * t])
        scale.update(path, velocity, np.array([0.0, truly / 4.0]), 1e-3)
    assert scale.estimate()[0] == pytest.approx(4.0, rel=0.02)


def test_nothing_is_known_before_anything_moved():
    scale = PathScale()
    assert scale.estimate() == (pytest.approx(math.nan, nan_ok=True), math.inf)
    scale.update(np.zeros(2), np.zeros(2), np.array([1e-3, -1e-3]), 1e-3)
    assert scale.estimate()[1] == math.inf


def test_dead_reckoning_without_limits_is_the_exact_arc():
    motion = DeadReckoning(None, 0.1).motion(Velocity(0.3, 0.5), 0.2)
    np.testing.assert_allclose(motion, step_exact(np.zeros(3), 0.3, 0.5, 0.2, 0.1))


def test_dead_reckoning_follows_the_ramp():
    """From rest to 0.2 m/s at 0.3 m/s²: the first second covers 0.2·1 − 0.2²/(2·0.3) m."""
    reckoning = DeadReckoning(load_robot("p3dx").operating, 0.0)
    travelled = sum(reckoning.motion(Velocity(0.2, 0.0), 0.1)[1] for _ in range(10))
    assert travelled == pytest.approx(0.2 - 0.04 / 0.6, abs=2e-3)


def test_no_time_no_motion():
    reckoning = DeadReckoning(load_robot("p3dx").operating, 0.0)
    np.testing.assert_array_equal(reckoning.motion(Velocity(0.2, 0.1), 0.0), np.zeros(3))
