"""The unicycle with a camera offset: exact arcs, Jacobians, frames."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from visctrl.robots.unicycle import (
    euler_jacobians,
    from_rep103,
    relative_pose,
    step_euler,
    step_exact,
    to_rep103,
    wrap_angle,
)

angle = st.floats(-10.0, 10.0)
length = st.floats(-20.0, 20.0)
poses = st.tuples(length, length, angle).map(np.array)
speed = st.floats(-1.0, 1.0)
offset = st.floats(-0.3, 0.3)


@given(pose=poses, v=speed, omega=speed, ell=offset)
def test_the_exact_step_is_the_limit_of_euler_steps(
    pose: np.ndarray, v: float, omega: float, ell: float
) -> None:
    errors = []
    for count in (50, 100):
        fine = pose
        for _ in range(count):
            fine = step_euler(fine, v, omega, 1.0 / count, ell)
        errors.append(np.abs(fine - step_exact(pose, v, omega, 1.0, ell)).max())
    assert errors[1] < 2e-2
    # First order: half the step leaves half the error.
    assert errors[1] <= 0.55 * errors[0] + 1e-9


@given(pose=poses, v=speed, omega=speed, ell=offset, split=st.floats(0.1, 0.9))
def test_exact_steps_compose(
    pose: np.ndarray, v: float, omega: float, ell: float, split: float
) -> None:
    whole = step_exact(pose, v, omega, 2.0, ell)
    parts = step_exact(
        step_exact(pose, v, omega, 2.0 * split, ell), v, omega, 2.0 - 2.0 * split, ell
    )
    assert np.allclose(whole, parts, atol=1e-9)


@given(pose=poses, v=speed, omega=speed, ell=offset)
def test_jacobians_are_the_derivatives(
    pose: np.ndarray, v: float, omega: float, ell: float
) -> None:
    F, G = euler_jacobians(pose, v, omega, 0.1, ell)
    h = 1e-6

    def at(p: np.ndarray, a: float, b: float) -> np.ndarray:
        return step_euler(p, a, b, 0.1, ell)

    for k, e in enumerate(np.eye(3)):
        slope = (at(pose + h * e, v, omega) - at(pose - h * e, v, omega)) / (2 * h)
        assert np.allclose(F[:, k], slope, atol=1e-7)
    for k, (a, b) in enumerate(((h, 0.0), (0.0, h))):
        slope = (at(pose, v + a, omega + b) - at(pose, v - a, omega - b)) / (2 * h)
        assert np.allclose(G[:, k], slope, atol=1e-7)


def test_forward_is_counter_clockwise_from_y() -> None:
    assert np.allclose(step_exact([0, 0, 0], 1.0, 0.0, 1.0), [0, 1, 0])
    assert np.allclose(step_exact([0, 0, math.pi / 2], 1.0, 0.0, 1.0), [-1, 0, math.pi / 2])
    # A quarter turn to the left on a circle of radius 1.
    quarter = step_exact([0, 0, 0], math.pi / 2, math.pi / 2, 1.0)
    assert np.allclose(quarter, [-1, 1, math.pi / 2])


@given(pose=poses, reference=poses)
def test_a_relative_pose_leads_back(pose: np.ndarray, reference: np.ndarray) -> None:
    x, y, phi = relative_pose(pose, reference)
    s, c = np.sin(reference[2]), np.cos(reference[2])
    back = [reference[0] + c * x - s * y, reference[1] + s * x + c * y]
    assert np.allclose(back, pose[:2], atol=1e-9)
    assert math.cos(phi + reference[2] - pose[2]) == pytest.approx(1.0)


@given(pose=poses)
def test_rep103_and_back(pose: np.ndarray) -> None:
    assert np.allclose(from_rep103(to_rep103(pose)), pose)
    X, Y, yaw = to_rep103([2.0, 5.0, 0.3])
    assert (X, Y, yaw) == (5.0, -2.0, 0.3)


@given(value=angle)
def test_wrapped_angles(value: float) -> None:
    wrapped = float(wrap_angle(value))
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped - value) == pytest.approx(1.0)


def test_everything_broadcasts() -> None:
    poses = np.zeros((4, 1, 3))
    out = step_exact(poses, np.linspace(0, 1, 5), 0.2, 0.1)
    assert out.shape == (4, 5, 3)
    F, G = euler_jacobians(poses, np.linspace(0, 1, 5), 0.2, 0.1)
    assert (F.shape, G.shape) == ((4, 5, 3, 3), (4, 5, 3, 2))
