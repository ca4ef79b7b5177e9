"""The twelve-element tensor: against projections of points, finite differences, and noise."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visctrl.geometry.trifocal.tensor2d import (
    ELEMENTS_2D,
    T212,
    T232,
    across,
    heading_2d,
    incidence,
    normalised_2d,
    ransac_2d,
    rates_2d,
    residuals_2d,
    solve_2d,
    tensor_2d_from_poses,
)
from visctrl.robots.unicycle import step_exact

poses = st.tuples(st.floats(-3.0, 3.0), st.floats(-9.0, -1.0), st.floats(-1.0, 1.0)).map(np.array)
SIGMA = 2e-3


def rays_from(points, pose, rng=None, sigma=0.0):
    s, c = math.sin(pose[2]), math.cos(pose[2])
    dx, dy = points[:, 0] - pose[0], points[:, 1] - pose[1]
    rays = np.stack([c * dx + s * dy, -s * dx + c * dy, points[:, 2]], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    if rng is not None:
        rays += sigma * rng.normal(size=rays.shape)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays


def three_views(pose_1, pose_2, seed=0, count=40, sigma=0.0):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) * [3.0, 3.0, 1.0]
    return [rays_from(points, pose, rng, sigma) for pose in (pose_1, pose_2, np.zeros(3))]


@given(poses, poses)
@settings(max_examples=30, deadline=None)
def test_points_are_incident_with_the_tensor_of_the_poses(pose_1, pose_2):
    relation = incidence(*three_views(pose_1, pose_2))
    tensor = tensor_2d_from_poses(pose_1, pose_2)
    assert np.abs(relation.error @ tensor).max() < 1e-12 * np.abs(tensor).max()


@given(poses, poses)
@settings(max_examples=30, deadline=None)
def test_rates_are_the_derivatives_of_the_elements(pose_1, pose_2):
    tensor, step = tensor_2d_from_poses(pose_1, pose_2), 1e-6
    J = rates_2d(tensor, pose_1[2], 1.0)
    for column, (v, omega) in enumerate(((1.0, 0.0), (0.0, 1.0))):
        ahead = tensor_2d_from_poses(pose_1, step_exact(pose_2, v, omega, step, 0.0))
        np.testing.assert_allclose(J[:, column], (ahead - tensor) / step, atol=1e-4)


@given(poses, poses)
@settings(max_examples=30, deadline=None)
def test_heading_comes_back(pose_1, pose_2):
    tensor, _ = normalised_2d(tensor_2d_from_poses(pose_1, pose_2), np.eye(12))
    ahead = -math.sin(pose_1[2]) * pose_1[0] + math.cos(pose_1[2]) * pose_1[1] < 0.0
    if ahead:
        assert heading_2d(tensor, pose_1[2]) == pytest.approx(pose_2[2], abs=1e-9)


def test_gradient_is_the_derivative_of_the_error():
    """Turning a ray by a small angle changes the error as the gradient says."""
    views = three_views(np.array([0.5, -3.0, 0.2]), np.array([0.2, -1.0, -0.1]), count=6)
    tensor = np.random.default_rng(1).normal(size=12)
    relation, step = incidence(*views), 1e-6
    for direction in range(6):
        moved = [view.copy() for view in views]
        # The directions of incidence() are those of rays with forward and up exchanged.
        swapped = moved[direction // 2][:, [0, 2, 1]]
        sideways = across(swapped)[:, direction % 2][:, [0, 2, 1]]
        moved[direction // 2] = moved[direction // 2] + step * sideways
        change = _with_directions_of(views, moved) @ tensor - relation.error @ tensor
        expected = relation.gradient[:, :, direction] @ tensor
        np.testing.assert_allclose(change / step, expected, atol=1e-4)


def _with_directions_of(views, moved):
    """Return the errors of moved rays, their frames turned with them by the smallest turn."""
    frames = []
    for before, after in zip(views, moved, strict=True):
        u, turned = before[:, [0, 2, 1]], after[:, [0, 2, 1]]
        a = across(u)
        frames.append((turned, a - np.einsum("nmi,ni->nm", a, turned)[..., None] * u[:, None]))
    (_, a), (_, b), (w, _) = frames
    index = [[int(name[at]) - 1 for name in ELEMENTS_2D] for at in (1, 2, 3)]
    forms = w[:, None, None, index[0]] * a[:, :, None, index[1]] * b[:, None, :, index[2]]
    return forms.reshape(len(w), 4, 12)


def test_three_features_are_enough_and_noise_free_points_give_the_tensor():
    pose_1, pose_2 = np.array([-0.5, -1.5, -0.4]), np.array([-0.3, -0.8, -0.2])
    truth, _ = normalised_2d(tensor_2d_from_poses(pose_1, pose_2), np.eye(12))
    views = three_views(pose_1, pose_2)
    found, _ = normalised_2d(*solve_2d(incidence(*views), SIGMA))
    np.testing.assert_allclose(found, truth, atol=1e-10)
    few = incidence(*(view[:3] for view in views))
    assert np.linalg.matrix_rank(few.error.reshape(-1, 12), tol=1e-9) == 11


def test_covariance_is_consistent():
    pose_1, pose_2 = np.array([-0.5, -1.5, -0.4]), np.array([-0.3, -0.8, -0.2])
    truth, _ = normalised_2d(tensor_2d_from_poses(pose_1, pose_2), np.eye(12))
    ratios = []
    for seed in range(30):
        relation = incidence(*three_views(pose_1, pose_2, seed, sigma=SIGMA))
        found, covariance = normalised_2d(*solve_2d(relation, SIGMA))
        values, vectors = np.linalg.eigh(covariance)
        # One direction is the scale, and one T's length that the normalisation takes away.
        whitened = (vectors[:, 2:].T @ (found - truth)) ** 2 / values[2:]
        ratios.append(whitened.mean())
    assert 0.6 < np.median(ratios) < 1.4


def test_outliers_are_found():
    pose_1, pose_2 = np.array([-0.5, -1.5, -0.4]), np.array([-0.3, -0.8, -0.2])
    one, two, three = three_views(pose_1, pose_2, sigma=SIGMA)
    two[:12] = np.roll(two[:12], 1, axis=0)
    relation = incidence(one, two, three)
    agreeing = ransac_2d(relation, SIGMA, seed=0, threshold_sigmas=4.0, hypotheses=100)
    assert agreeing[12:].mean() > 0.9
    assert agreeing[:12].sum() <= 2
    truth = tensor_2d_from_poses(pose_1, pose_2)
    assert np.median(residuals_2d(relation, truth, SIGMA)[12:]) < 1.5


def test_at_the_target_only_the_direction_of_the_baseline_is_lost():
    """Normalised by its length, the elements that must vanish still do."""
    pose_1 = np.array([-0.5, -1.5, -0.4])
    relation = incidence(*three_views(pose_1, np.zeros(3), sigma=SIGMA))
    found, _ = normalised_2d(*solve_2d(relation, SIGMA))
    goal = np.zeros(12)
    goal[[0, 4, 9]], goal[[2, 7, 11]] = found[T212], found[T232]
    np.testing.assert_allclose(found, goal, atol=10 * SIGMA)
