from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visctrl.geometry.two_view.planar import PlanarMotion, refine_planar_motion
from visctrl.perception.three_view import ThreeViewMap, _seen

SIGMA = np.radians(0.05)


def world(count, seed):
    """Return points all round the target (metres, the camera's height is 0)."""
    rng = np.random.default_rng(seed)
    bearing, distance = rng.uniform(-np.pi, np.pi, count), rng.uniform(2.0, 6.0, count)
    height = rng.uniform(-1.0, 1.5, count)
    return np.stack([distance * np.sin(bearing), distance * np.cos(bearing), height], axis=-1)


def seen(points, pose, noise=0.0, seed=0):
    """Return unit rays of points from a pose, with noise on both angles."""
    x, y, phi = pose
    right = (points[:, 0] - x) * np.cos(phi) + (points[:, 1] - y) * np.sin(phi)
    forward = -(points[:, 0] - x) * np.sin(phi) + (points[:, 1] - y) * np.cos(phi)
    rng = np.random.default_rng(seed)
    bearing = np.arctan2(right, forward) + rng.normal(scale=noise, size=len(points))
    tangent = points[:, 2] / np.hypot(right, forward)
    tangent = tangent + rng.normal(scale=noise, size=len(points))
    rays = np.stack([np.sin(bearing), np.cos(bearing), tangent], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def motion_to(pose):
    return PlanarMotion(
        pose[2], float(np.arctan2(pose[0], pose[1])), np.zeros((2, 2)), np.ones(0, dtype=bool)
    )


poses = st.tuples(st.floats(-1.2, 1.2), st.floats(-1.9, -0.6), st.floats(-0.7, 0.7))


@settings(max_examples=40)
@given(poses, poses, st.integers(0, 999))
def test_without_noise_the_pose_is_exact_in_units_of_the_baseline(initial, current, seed):
    points = world(60, seed)
    map_ = ThreeViewMap(seen(points, (0, 0, 0)), seen(points, initial), motion_to(initial), SIGMA)
    which = np.arange(60)
    fit = map_.fit(which, seen(points, current), map_.initial_pose, SIGMA)
    baseline = np.hypot(initial[0], initial[1])
    expected = [current[0] / baseline, current[1] / baseline, current[2]]
    np.testing.assert_allclose(fit.pose, expected, atol=2e-3)
    assert fit.inliers.mean() > 0.95
    rays, _ = map_.predict(which, fit.pose)
    assert np.median(np.abs(rays - seen(points, current))) < 1e-3


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_outliers_are_named_and_do_no_harm(share):
    initial, current = (-0.55, -1.35, -0.6), (-0.3, -0.8, -0.2)
    points = world(120, 1)
    target = seen(points, (0, 0, 0), SIGMA, 1)
    first = seen(points, initial, SIGMA, 2)
    motion = refine_planar_motion(target, first, -0.55, -2.7, SIGMA)
    map_ = ThreeViewMap(target, first, motion, SIGMA)
    now = seen(points, current, SIGMA, 3)
    wrong = np.random.default_rng(4).permutation(120)[: int(120 * share)]
    now[wrong] = seen(points[wrong], current, np.radians(8), 5)
    fit = map_.fit(np.arange(120), now, map_.initial_pose, SIGMA)
    truth = np.array([-0.3, -0.8]) / np.hypot(0.55, 1.35)
    np.testing.assert_allclose(fit.pose[:2], truth, atol=0.01)
    assert fit.pose[2] == pytest.approx(-0.2, abs=np.radians(0.2))
    clean = np.setdiff1d(np.arange(120), wrong)
    assert fit.inliers[clean].mean() > 0.97
    # What stays is hidden where the map is uncertain: along the baseline, or by chance.
    assert fit.inliers[wrong].mean() < 0.25
    assert fit.residual_sd == pytest.approx(SIGMA * np.sqrt(2), rel=0.6)


def test_a_view_is_located_from_its_planar_motion_alone():
    initial, current = (0.6, -2.0, 0.3), (0.25, -0.7, -0.1)
    points = world(80, 7)
    target, first = seen(points, (0, 0, 0), SIGMA, 1), seen(points, initial, SIGMA, 2)
    map_ = ThreeViewMap(target, first, motion_to(initial), SIGMA)
    now = seen(points, current, SIGMA, 3)
    fit = map_.locate(np.arange(80), now, motion_to(current), SIGMA)
    baseline = np.hypot(0.6, 2.0)
    np.testing.assert_allclose(fit.pose[:2] * baseline, current[:2], atol=0.02)
    assert fit.share > 0.95


@pytest.mark.parametrize("initial", [(0.0, 0.0, 0.0), (0.0, 0.0, 0.4), (0.0, -0.01, 0.0)])
def test_without_a_baseline_turning_still_fits(initial):
    points = world(60, 3)
    target, first = seen(points, (0, 0, 0), SIGMA, 1), seen(points, initial, SIGMA, 2)
    map_ = ThreeViewMap(target, first, motion_to(initial), SIGMA)
    now = seen(points, (0.0, 0.0, 0.2), SIGMA, 3)
    fit = map_.fit(np.arange(60), now, map_.initial_pose, SIGMA)
    assert np.isfinite(fit.pose).all()
    assert fit.pose[2] == pytest.approx(0.2, abs=np.radians(1.0))
    assert fit.share > 0.8


def test_no_features_give_a_fit_that_nobody_trusts():
    points = world(20, 3)
    map_ = ThreeViewMap(
        seen(points, (0, 0, 0)), seen(points, (0.2, -1.0, 0)), motion_to((0.2, -1.0, 0)), SIGMA
    )
    none = np.zeros(0, dtype=np.intp)
    fit = map_.fit(none, np.zeros((0, 3)), map_.initial_pose, SIGMA)
    assert fit.share == 0.0
    assert np.isfinite(fit.pose).all()


def test_the_jacobian_is_that_of_the_prediction():
    points = world(30, 9)
    initial = (-0.4, -1.5, 0.2)
    map_ = ThreeViewMap(seen(points, (0, 0, 0)), seen(points, initial), motion_to(initial), SIGMA)
    which, pose, step = np.arange(30), np.array([-0.3, -0.6, 0.1]), 1e-6
    bearings = _seen(seen(points, (-0.5, -0.9, 0.12)))
    _, J, _ = map_._linearise(which, bearings, pose, SIGMA)
    for k in range(3):
        change = np.eye(3)[k] * step
        high, _, _ = map_._linearise(which, bearings, pose + change, SIGMA)
        low, _, _ = map_._linearise(which, bearings, pose - change, SIGMA)
        # The residual is what is seen minus what is predicted.
        np.testing.assert_allclose(-(high - low) / (2 * step), J[:, :, k], atol=1e-5)
