"""The tensor's algebra: closed form, constraints, gauge, dynamics, limits at start and goal."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from three_views import TARGET, line_determinants, points_seen, random_poses, rays_seen, scene

from visctrl.geometry.trifocal import tensor as trifocal
from visctrl.geometry.trifocal.tensor import T111, T112, T121, T122, T211, T212, T221, T222
from visctrl.robots.unicycle import step_exact

poses = st.tuples(st.floats(-5.0, 5.0), st.floats(-15.0, -0.5), st.floats(-1.3, 1.3)).map(np.array)


@given(poses, poses)
def test_true_bearings_fulfil_the_closed_form(initial, current):
    points = scene(np.random.default_rng(3), 12, 20.0, 40.0)
    views = [points_seen(points, pose) for pose in (initial, current, TARGET)]
    T = trifocal.tensor_from_poses(initial, current)
    error = trifocal.trilinear(*views).error @ T
    assert np.abs(error).max() < 1e-9 * max(1.0, np.abs(T).max())


def test_the_relation_is_that_three_lines_meet():
    """For any bearings, T(u, v, w) equals the determinant of the rays' lines, up to one factor."""
    rng = np.random.default_rng(0)
    initial, current = random_poses(rng)
    T = trifocal.tensor_from_poses(initial, current)
    angles = rng.uniform(-np.pi, np.pi, (3, 40))
    bearings = np.stack([np.sin(angles), np.cos(angles)], axis=-1)
    expected = line_determinants(None, (initial, current, TARGET), bearings)
    error = trifocal.trilinear(*bearings).error @ T
    factor = expected[0] / error[0]
    np.testing.assert_allclose(error * factor, expected, atol=1e-12)
    assert abs(factor) == pytest.approx(1.0)


@given(poses, poses)
def test_calibration_constraints(initial, current):
    T = trifocal.tensor_from_poses(initial, current)
    assert np.abs(trifocal.CALIBRATION @ T).max() < 1e-9 * np.abs(T).max() + 1e-12
    np.testing.assert_allclose(trifocal.CALIBRATED @ (trifocal.CALIBRATED.T @ T), T, atol=1e-9)


def test_the_printed_constraint_does_not_hold():
    T = trifocal.tensor_from_poses(np.array([1.0, -3.0, 0.4]), np.array([0.3, -1.5, -0.2]))
    assert abs(T[T112] + T[T121] + T[T211] + T[T222]) > 0.1


@given(poses, st.floats(0.1, 10.0))
def test_gauge_freedom(initial, factor):
    """A scene of another size gives the same tensor up to scale; normalisation removes it."""
    current = 0.5 * initial
    larger = [pose * [factor, factor, 1.0] for pose in (initial, current)]
    T = trifocal.tensor_from_poses(initial, current)
    np.testing.assert_allclose(
        trifocal.tensor_from_poses(*larger), factor * T, rtol=1e-9, atol=1e-9
    )
    if abs(T[T121]) > 1e-3:
        normalised = trifocal.normalised(T)
        np.testing.assert_allclose(
            trifocal.normalised(-factor * T), normalised, rtol=1e-9, atol=1e-9
        )
        assert normalised[T121] == 1.0


@given(poses)
def test_elements_at_start_and_goal(initial):
    start = trifocal.tensor_from_poses(initial, initial)
    assert np.abs(start[[T111, T112, T221, T222]]).max() < 1e-9
    assert abs(start[T121] + start[T211]) < 1e-9
    goal = trifocal.tensor_from_poses(initial, TARGET)
    assert np.abs(goal[[T111, T122, T211, T222]]).max() < 1e-9
    assert abs(goal[T112] + goal[T121]) < 1e-9
    assert abs(goal[T212] + goal[T221]) < 1e-9


@given(poses, poses, st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.sampled_from([0.0, 0.1]))
@settings(max_examples=50)
def test_dynamics_are_the_derivative_of_the_closed_form(initial, current, v, omega, offset):
    step = 1e-5
    ahead = step_exact(current, v, omega, step, offset)
    behind = step_exact(current, v, omega, -step, offset)
    slope = (
        trifocal.tensor_from_poses(initial, ahead) - trifocal.tensor_from_poses(initial, behind)
    ) / (2.0 * step)
    scale = 7.0
    T = trifocal.tensor_from_poses(initial, current) / scale
    rates = trifocal.dynamics(T, initial[2], scale, v, omega, offset)
    np.testing.assert_allclose(rates, slope / scale, atol=1e-6)


def test_everything_broadcasts_over_robots():
    rng = np.random.default_rng(1)
    pairs = [random_poses(rng) for _ in range(6)]
    initial, current = (np.stack(side).reshape(2, 3, 3) for side in zip(*pairs, strict=True))
    together = trifocal.tensor_from_poses(initial, current)
    for k, (a, b) in enumerate(pairs):
        np.testing.assert_allclose(
            together.reshape(6, 8)[k], trifocal.tensor_from_poses(a, b), atol=1e-12
        )
    views = [np.random.default_rng(2).normal(size=(2, 3, 9, 2)) for _ in range(3)]
    relation = trifocal.trilinear(*views)
    single = trifocal.trilinear(*(view[1, 2] for view in views))
    np.testing.assert_allclose(relation.error[1, 2], single.error)
    np.testing.assert_allclose(relation.gradient[:, 1, 2], single.gradient)


@given(poses)
def test_view_parameters_and_pose_are_inverse(pose):
    target = trifocal.target_in_view(pose)
    np.testing.assert_allclose(trifocal.pose_of_view(pose[2], target), pose, atol=1e-12)


def test_either_view_enters_linearly():
    rng = np.random.default_rng(4)
    view_1, view_2 = rng.normal(size=(2, 4))
    T = trifocal.tensor_of_views(view_1, view_2)
    np.testing.assert_allclose(trifocal.current_view_basis(view_1) @ view_2, T)
    np.testing.assert_allclose(trifocal.initial_view_basis(view_2) @ view_1, T)


def _linear(relation, T):
    linear = trifocal.linearised(relation, T)
    return linear.residual, linear.jacobian(relation).T


def test_sampson_jacobian_by_finite_differences():
    rng = np.random.default_rng(5)
    relation = trifocal.trilinear(*rng.normal(size=(3, 30, 3)))
    T = rng.normal(size=8)
    residual, jacobian = _linear(relation, T)
    np.testing.assert_allclose(residual, trifocal.sampson_residuals(relation, T))
    step = 1e-6
    for k, axis in enumerate(np.eye(8)):
        ahead = trifocal.sampson_residuals(relation, T + step * axis)
        behind = trifocal.sampson_residuals(relation, T - step * axis)
        np.testing.assert_allclose(jacobian[:, k], (ahead - behind) / (2 * step), atol=1e-6)


def test_sampson_residual_has_the_noise_of_one_direction():
    """With 1 mrad noise on every ray, residuals at the truth have a spread of 1 mrad."""
    rng = np.random.default_rng(6)
    initial, current = random_poses(rng)
    points = scene(rng, 4000)
    sigma = 1e-3
    views = [rays_seen(points, pose, rng, sigma) for pose in (initial, current, TARGET)]
    residual = trifocal.sampson_residuals(
        trifocal.trilinear(*views), trifocal.tensor_from_poses(initial, current)
    )
    assert 1.4826 * np.median(np.abs(residual)) == pytest.approx(sigma, rel=0.06)


def test_normalised_covariance_by_finite_differences():
    rng = np.random.default_rng(7)
    T = rng.normal(size=8) + np.eye(8)[T121] * 3.0
    step = 1e-6
    J = np.stack(
        [
            (trifocal.normalised(T + step * e) - trifocal.normalised(T - step * e)) / (2 * step)
            for e in np.eye(8)
        ],
        axis=-1,
    )
    A = rng.normal(size=(8, 8))
    C = A @ A.T
    np.testing.assert_allclose(trifocal.normalised_covariance(T, C), J @ C @ J.T, atol=1e-6)


def test_element_names_follow_the_order_of_the_arrays():
    order = (T111, T112, T121, T122, T211, T212, T221, T222)
    assert order == tuple(range(8))
    assert trifocal.ELEMENTS[T212] == "T212"
