"""The source's observability statements as rank tests, and where they do not hold."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from visctrl.geometry.observability import (
    Output,
    discrete_matrix,
    lie_matrix,
    rank,
    singular_values,
    stripped_matrix,
    unobservable,
)
from visctrl.geometry.pose_outputs import epipole_bearings, metric_elements, normalised_elements
from visctrl.geometry.trifocal.tensor import ELEMENTS

Array = NDArray[np.float64]
SEEDS = st.integers(0, 2**32 - 1)
OFFSET = 0.08
INITIAL = np.array([-6.0, -16.0, -0.35])
POSE = np.array([-3.0, -9.0, -0.5])
TELLING = [name for name in ELEMENTS if name not in ("T121", "T111")]


def both_epipoles(pose: Array) -> tuple[Array, Array]:
    return epipole_bearings(pose, np.zeros(3))


def target_epipole(pose: Array) -> tuple[Array, Array]:
    value, slope = both_epipoles(pose)
    return value[..., :1], slope[..., :1, :]


def current_epipole(pose: Array) -> tuple[Array, Array]:
    value, slope = both_epipoles(pose)
    return value[..., 1:], slope[..., 1:, :]


def element(name: str, *, over_t121: bool) -> Output:
    k = ELEMENTS.index(name)
    elements = normalised_elements if over_t121 else metric_elements

    def output(pose: Array) -> tuple[Array, Array]:
        value, slope = elements(pose, INITIAL)
        return value[..., [k]], slope[..., [k], :]

    return output


@given(SEEDS)
def test_outputs_have_the_derivatives_of_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose = rng.uniform([-8, -15, -1], [8, -3, 1])
    h = 1e-6
    for output in (
        both_epipoles,
        lambda p: metric_elements(p, INITIAL),
        lambda p: normalised_elements(p, INITIAL),
        lambda p: epipole_bearings(p, INITIAL),
    ):
        value, slope = output(pose)
        if np.abs(value).max() > 50.0:
            continue
        for k in range(3):
            step = h * np.eye(3)[k]
            difference = (output(pose + step)[0] - output(pose - step)[0]) / (2 * h)
            assert_allclose(slope[:, k], difference, rtol=1e-4, atol=1e-5)


def test_epipole_derivatives_are_those_of_the_source() -> None:
    """(4.5) is for e = αx tan θ: its rows are αx (1 + tan²θ) times those of the bearings."""
    x, y, phi = POSE
    alpha = 600.0
    d = y * np.cos(phi) - x * np.sin(phi)
    source = alpha * np.array([np.array([y, -x, x * x + y * y]) / d**2, [1 / y, -x / y**2, 0.0]])
    value, slope = both_epipoles(POSE)
    rows = alpha * (1 + np.tan(value[::-1]) ** 2)[:, None] * slope[::-1]
    assert_allclose(rows, source, rtol=1e-12)


@pytest.mark.parametrize("output", [both_epipoles, target_epipole], ids=["both", "target alone"])
def test_epipoles_make_the_pose_locally_weakly_observable(output: Output) -> None:
    assert rank(lie_matrix(output, POSE, OFFSET), length=9.0) == 3


def test_lie_derivatives_of_the_current_epipole_tell_two_directions_only() -> None:
    """(4.3): turning all about the target leaves it unchanged."""
    lost = unobservable(lie_matrix(current_epipole, POSE, OFFSET), length=1.0)
    about = np.array([-POSE[1], POSE[0], 1.0])
    assert len(lost) == 1
    assert abs(lost[0] @ about) == pytest.approx(np.linalg.norm(about), rel=1e-6)


def test_translation_along_the_baseline_loses_observability() -> None:
    towards = np.array([-3.0, -9.0, np.arctan2(-3.0, 9.0)])
    aside = towards + np.array([0.0, 0.0, 0.3])
    assert rank(lie_matrix(target_epipole, towards, OFFSET, "translation"), length=9.0) < 3
    assert rank(lie_matrix(target_epipole, aside, OFFSET, "translation"), length=9.0) == 3
    assert rank(lie_matrix(target_epipole, towards, OFFSET), length=9.0) == 3


def test_rotation_tells_by_itself_only_with_the_camera_off_the_axle() -> None:
    matrix = lie_matrix(target_epipole, POSE, OFFSET, "rotation")
    centred = lie_matrix(target_epipole, POSE, 0.0, "rotation")
    assert rank(matrix, length=9.0) == 3
    assert rank(centred, length=9.0) == 1


@pytest.mark.parametrize("name", ELEMENTS)
def test_no_metric_element_makes_the_pose_locally_weakly_observable(name: str) -> None:
    output = element(name, over_t121=False)
    assert rank(lie_matrix(output, POSE, OFFSET), length=9.0) == 2


@pytest.mark.parametrize("name", ELEMENTS)
@given(seed=SEEDS)
def test_a_metric_element_tells_two_directions_however_long_it_is_watched(
    name: str, seed: int
) -> None:
    """Against (4.13), (4.14): different turning rates in consecutive steps do not help."""
    rng = np.random.default_rng(seed)
    velocities = np.stack([rng.uniform(0.1, 0.4, 8), rng.uniform(-0.5, 0.5, 8)], axis=-1)
    matrix = discrete_matrix(element(name, over_t121=False), POSE, velocities, 0.5, OFFSET)
    assert rank(matrix, length=9.0) <= 2


@pytest.mark.parametrize("name", TELLING)
def test_an_element_over_t121_tells_all_three(name: str) -> None:
    output = element(name, over_t121=True)
    steps = np.array([[0.2, 0.3], [0.2, -0.2]])
    assert rank(discrete_matrix(output, POSE, steps, 0.5, OFFSET), length=9.0) == 3
    assert rank(lie_matrix(output, POSE, OFFSET), length=9.0) == 3


def test_t111_over_t121_is_the_bearing_of_a_fixed_point() -> None:
    """The element that the source takes: going round that point changes nothing, for ever."""
    x1, y1, phi1 = INITIAL
    # Where the x axes of the initial and the target view meet.
    right, forth = x1 - y1 / np.tan(phi1) - POSE[0], -POSE[1]
    bearing = np.arctan2(right, forth) + POSE[2]
    output = element("T111", over_t121=True)
    assert output(POSE)[0][0] == pytest.approx(-1 / np.tan(bearing))
    velocities = np.random.default_rng(0).uniform([0.1, -0.5], [0.4, 0.5], (8, 2))
    matrix = discrete_matrix(output, POSE, velocities, 0.5, OFFSET)
    lost = unobservable(matrix)
    about = np.array([forth, -right, 1.0])
    assert len(lost) == 1
    assert abs(lost[0] @ about) == pytest.approx(np.linalg.norm(about), rel=1e-6)


@pytest.mark.parametrize("name", ELEMENTS)
def test_the_linearised_filter_believes_to_see_all_three(name: str) -> None:
    """(4.15) has full rank when the robot turns, and loses it when it does not."""
    output = element(name, over_t121=False)
    turning = np.array([[0.2, 0.3], [0.2, -0.2]])
    straight = np.array([[0.2, 0.0], [0.2, 0.0]])
    assert rank(stripped_matrix(output, POSE, turning, 0.5, OFFSET), length=9.0) == 3
    assert rank(stripped_matrix(output, POSE, straight, 0.5, OFFSET), length=9.0) < 3


def test_two_steps_of_the_target_epipole_tell_the_pose() -> None:
    steps = np.array([[0.2, 0.3], [0.2, -0.2]])
    for matrix in (discrete_matrix, stripped_matrix):
        assert rank(matrix(target_epipole, POSE, steps, 0.5, OFFSET), length=9.0) == 3


def test_standing_still_tells_no_more_than_one_look() -> None:
    still = discrete_matrix(target_epipole, POSE, np.zeros((5, 2)), 0.1, OFFSET)
    assert rank(still, length=9.0) == 1
    assert len(unobservable(still, length=9.0)) == 2
    assert singular_values(still, length=9.0)[1] < 1e-12
