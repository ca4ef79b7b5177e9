"""The transfer of bearings against points seen from three poses, and against differences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from visctrl.geometry.trifocal.transfer import bearings, transfer_bearing, wrap_half_turn

Array = NDArray[np.float64]
SEEDS = st.integers(0, 2**32 - 1)


def _scene(seed: int, count: int = 12) -> tuple[Array, Array, Array]:
    """Return C1, C2 and points (N, 2) that lie on no line through two of the centres."""
    rng = np.random.default_rng(seed)
    initial = np.array([rng.uniform(-8, 8), rng.uniform(-18, -4), rng.uniform(-1.5, 1.5)])
    current = np.array([rng.uniform(-8, 8), rng.uniform(-18, 2), rng.uniform(-3, 3)])
    angle = rng.uniform(-np.pi, np.pi, count)
    radius = rng.uniform(20, 40, count)
    return initial, current, np.stack([radius * np.sin(angle), radius * np.cos(angle)], axis=-1)


def _bearing(points: Array, pose: Array) -> Array:
    d = points - pose[:2]
    return np.arctan2(d[:, 0], d[:, 1]) + pose[2]


@given(SEEDS)
def test_transfer_predicts_where_points_are_seen(seed: int) -> None:
    initial, current, points = _scene(seed)
    found = transfer_bearing(
        initial, current, _bearing(points, initial), _bearing(points, np.zeros(3))
    )
    # Near-zero parallax amplifies rounding by its inverse.
    good = np.abs(found.parallax) > 1e-3
    error = wrap_half_turn(found.bearing - _bearing(points, current))
    assert_allclose(error[good], 0.0, atol=1e-9)


@given(SEEDS, st.floats(0.05, 20.0))
def test_scale_of_the_positions_is_free(seed: int, scale: float) -> None:
    initial, current, points = _scene(seed)
    theta1, theta3 = _bearing(points, initial), _bearing(points, np.zeros(3))
    unit = np.array([scale, scale, 1.0])
    one = transfer_bearing(initial, current, theta1, theta3)
    other = transfer_bearing(initial * unit, current * unit, theta1, theta3)
    assert_allclose(wrap_half_turn(one.bearing - other.bearing), 0.0, atol=1e-9)


@given(SEEDS)
def test_transfer_jacobians_are_those_of_differences(seed: int) -> None:
    initial, current, points = _scene(seed)
    theta = np.stack([_bearing(points, initial), _bearing(points, np.zeros(3))], axis=-1)
    found = transfer_bearing(initial, current, theta[:, 0], theta[:, 1])
    good = np.abs(found.parallax) > 0.05
    h = 1e-6

    def difference(d_initial: Array, d_current: Array, d_theta: Array) -> Array:
        ends = [
            transfer_bearing(
                initial + s * d_initial,
                current + s * d_current,
                theta[:, 0] + s * d_theta[0],
                theta[:, 1] + s * d_theta[1],
            ).bearing
            for s in (h, -h)
        ]
        return wrap_half_turn(ends[0] - ends[1])[good] / (2 * h)

    zero3, zero2 = np.zeros(3), np.zeros(2)
    for k in range(3):
        step = np.eye(3)[k]
        close = {"rtol": 1e-4, "atol": 1e-6}
        assert_allclose(difference(step, zero3, zero2), found.by_initial[k, good], **close)
        assert_allclose(difference(zero3, step, zero2), found.by_current[k, good], **close)
    for k in range(2):
        assert_allclose(difference(zero3, zero3, np.eye(2)[k]), found.by_bearings[k, good], **close)


def test_transfer_broadcasts_over_robots_and_features() -> None:
    initial, current, points = _scene(3)
    theta1, theta3 = _bearing(points, initial), _bearing(points, np.zeros(3))
    poses = current + np.random.default_rng(0).normal(0, 0.3, (5, 1, 3))
    found = transfer_bearing(initial, poses, theta1, theta3)
    assert found.bearing.shape == (5, 12)
    assert found.by_bearings.shape == (2, 5, 12)
    one = transfer_bearing(initial, poses[3, 0], theta1, theta3)
    assert_allclose(found.by_initial[:, 3], one.by_initial)


def test_a_feature_on_the_current_camera_gives_finite_numbers() -> None:
    found = transfer_bearing([1.0, -4.0, 0.0], [0.0, 0.0, 0.0], 0.3, 0.3)
    assert all(np.isfinite(part).all() for part in found)


def test_bearings_are_clockwise_from_forward() -> None:
    assert_allclose(bearings([[1, 0, 0], [0, 1, 0.5], [-1, 0, 0]]), [np.pi / 2, 0, -np.pi / 2])


@pytest.mark.parametrize("angle", [0.0, np.pi, -np.pi, 3 * np.pi])
def test_wrap_half_turn_ignores_half_turns(angle: float) -> None:
    assert abs(wrap_half_turn(angle)) < 1e-12
