"""Epipoles of planar motion without calibration."""

from __future__ import annotations

import math

import numpy as np
import pytest
from epipolar_world import PERSPECTIVE, World
from hypothesis import given, settings
from hypothesis import strategies as st

from visctrl.geometry.two_view.planar import ransac_planar_motion
from visctrl.geometry.two_view.planar_free import (
    constraint_rows,
    null_vectors,
    ransac_planar_epipoles,
    refine_epipoles,
    sampson_residuals,
    turned,
)
from visctrl.geometry.two_view.planar_free_residuals import PointPairs
from visctrl.robots.unicycle import wrap_angle

Pose = tuple[float, float, float]


def image_points(pose: Pose, points: np.ndarray) -> np.ndarray:
    """(right, up)/forward of points seen from a pose, by plain trigonometry."""
    x, y, phi = pose
    right = (points[:, 0] - x) * math.cos(phi) + (points[:, 1] - y) * math.sin(phi)
    forward = -(points[:, 0] - x) * math.sin(phi) + (points[:, 1] - y) * math.cos(phi)
    return np.stack([right / forward, points[:, 2] / forward], axis=-1)


def bearing_of(other: Pose, seen_from: Pose) -> float:
    """Bearing (clockwise from forward) of one pose's centre, seen from another pose."""
    dx, dy = other[0] - seen_from[0], other[1] - seen_from[1]
    return float(wrap_angle(math.atan2(dx, dy) + seen_from[2]))


def scene(seed: int, count: int = 60) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low, high = [-4.0, 4.0, -2.0], [4.0, 12.0, 2.0]
    return rng.uniform(low, high, (count, 3))


poses = st.tuples(
    st.floats(-2.0, 2.0), st.floats(-8.0, -0.5), st.floats(math.radians(-15), math.radians(15))
)


@given(poses, st.integers(0, 1000), st.floats(0.4, 2.5), st.floats(-0.05, 0.05))
@settings(max_examples=60, deadline=None)
def test_epipoles_are_exact_whatever_the_focal_length_and_centre(
    pose: Pose, seed: int, focal: float, shift: float
) -> None:
    points = scene(seed)

    def believed(p: np.ndarray) -> np.ndarray:
        return p * focal + [shift, 0.0]

    origin = (0.0, 0.0, 0.0)
    a, b = believed(image_points(pose, points)), believed(image_points(origin, points))
    found = ransac_planar_epipoles(a, b, 1e-5, seed=seed)
    expected = [
        focal * math.tan(t) + shift for t in (bearing_of(origin, pose), bearing_of(pose, origin))
    ]
    epipoles = [math.tan(found.direction), math.tan(found.direction + found.phi)]
    assert found.determined
    assert epipoles == pytest.approx(expected, rel=1e-5, abs=1e-5)


@given(poses, st.integers(0, 1000))
@settings(max_examples=40, deadline=None)
def test_the_sense_of_the_baseline_is_that_of_the_points(pose: Pose, seed: int) -> None:
    points = scene(seed)
    origin = (0.0, 0.0, 0.0)
    there = ransac_planar_epipoles(image_points(pose, points), image_points(origin, points), 1e-5)
    back = ransac_planar_epipoles(image_points(origin, points), image_points(pose, points), 1e-5)
    assert wrap_angle(there.direction - bearing_of(origin, pose)) == pytest.approx(0.0, abs=1e-5)
    assert wrap_angle(back.direction - bearing_of(pose, origin)) == pytest.approx(0.0, abs=1e-5)
    assert there.phi == pytest.approx(-pose[2], abs=1e-5)
    assert back.phi == pytest.approx(pose[2], abs=1e-5)


def test_an_epipole_at_infinity_is_like_any_other() -> None:
    points = scene(3)
    beside = (1.0, 0.0, 0.0)
    found = ransac_planar_epipoles(
        image_points(beside, points), image_points((0.0, 0.0, 0.0), points), 1e-5
    )
    assert math.degrees(found.direction) == pytest.approx(-90.0, abs=1e-3)


def test_null_vectors_are_orthogonal_to_their_rows() -> None:
    rows = np.random.default_rng(0).normal(size=(50, 3, 4))
    m = null_vectors(rows)
    assert np.abs(rows @ m[..., None]).max() < 1e-12
    assert np.linalg.norm(m, axis=-1) == pytest.approx(np.ones(50))


def test_null_vectors_of_dependent_rows_are_still_unit_vectors() -> None:
    m = null_vectors(np.zeros((2, 3, 4)))
    assert np.linalg.norm(m, axis=-1) == pytest.approx([1.0, 1.0])


def test_residual_derivatives_agree_with_differences() -> None:
    rng = np.random.default_rng(1)
    a, b, m = rng.normal(size=(20, 2)), rng.normal(size=(20, 2)), rng.normal(size=4)
    _, jacobian = sampson_residuals(a, b, m)
    step = 1e-6
    for k in range(4):
        shift = step * np.eye(4)[k]
        high, low = sampson_residuals(a, b, m + shift)[0], sampson_residuals(a, b, m - shift)[0]
        assert jacobian[k] == pytest.approx((high - low) / (2 * step), abs=1e-6)


def test_residuals_have_the_noise_of_one_coordinate() -> None:
    points, rng, sigma = scene(5, 4000), np.random.default_rng(2), 1e-3
    pose = (0.8, -4.0, 0.1)
    a, b = image_points(pose, points), image_points((0.0, 0.0, 0.0), points)
    exact = np.array(
        [
            f(bearing)
            for bearing in (
                bearing_of((0, 0, 0), pose),
                bearing_of(pose, (0, 0, 0)) + math.pi,
            )
            for f in (math.cos, math.sin)
        ]
    )
    assert np.abs(constraint_rows(a, b) @ exact).max() < 1e-12
    a, b = a + rng.normal(0, sigma, a.shape), b + rng.normal(0, sigma, b.shape)
    residual, _ = sampson_residuals(a, b, exact)
    assert residual.std() == pytest.approx(sigma, rel=0.05)


def test_turning_a_view_moves_only_its_own_bearing() -> None:
    m = np.array([math.cos(0.3), math.sin(0.3), math.cos(-0.2), math.sin(-0.2)])
    after = turned(m, 0.1, 0.0)
    assert math.atan2(after[1], after[0]) == pytest.approx(0.4)
    assert math.atan2(after[3], after[2]) == pytest.approx(-0.2)


@pytest.mark.parametrize("baseline", [5.0, 1.0])
def test_standard_deviations_are_those_of_the_errors(baseline: float) -> None:
    start = (0.1 * baseline, -baseline, 0.05)
    scaled, turns = [], []
    for seed in range(60):
        found = _pair(World(start, noise_px=0.5, seed=seed), start, seed)
        error = wrap_angle(found.direction - bearing_of((0, 0, 0), start))
        scaled.append(float(error) / found.direction_sd)
        turns.append(math.degrees(float(found.phi + start[2])))
    # The median absolute deviation of a unit normal is 0.674.
    assert 0.45 < np.median(np.abs(scaled)) < 0.95
    assert np.median(np.abs(turns)) < 0.15


def test_a_fifth_of_gross_outliers_hardly_matters() -> None:
    start = (0.5, -5.0, 0.05)
    errors = []
    for seed in range(40):
        found = _pair(World(start, noise_px=0.5, seed=seed, outliers=0.2), start, seed)
        errors.append(abs(float(wrap_angle(found.direction - bearing_of((0, 0, 0), start)))))
    assert math.degrees(np.median(errors)) < 0.25
    assert math.degrees(np.percentile(errors, 90)) < 0.8


def test_identical_views_are_named_and_their_turn_is_known() -> None:
    start = (0.0, 0.0, 0.05)
    for seed in range(10):
        found = _pair(World(start, noise_px=0.5, seed=seed, outliers=0.15), start, seed)
        assert found.found
        assert not found.determined
        assert "short baseline" in found.reason
        assert math.degrees(abs(found.phi + 0.05)) < 0.2


def test_too_few_features_and_garbage_are_results_with_a_name() -> None:
    rng = np.random.default_rng(0)
    few = ransac_planar_epipoles(rng.normal(size=(4, 2)), rng.normal(size=(4, 2)), 1e-3)
    none = ransac_planar_epipoles(rng.normal(size=(40, 2)), rng.normal(size=(40, 2)), 1e-6)
    assert not few.found
    assert not none.found
    assert "too few features: 4" in few.reason
    assert "no agreement" in none.reason
    assert np.isinf(few.direction_sd)


@pytest.mark.parametrize("off", [0.002, 0.005])
def test_following_ends_where_searching_does(off: float) -> None:
    """A start that is off by several times the noise in both views, a third of it outliers."""
    start, agreeing = (1.0, -4.0, 0.1), 0
    for seed in range(20):
        world = World(start, noise_px=0.5, seed=seed, outliers=0.2)
        views = world.views(start, 0.0)
        a, b = (rays[:, [0, 2]] / rays[:, 1:2] for rays in (views.current, views.target))
        searched = ransac_planar_epipoles(a, b, views.sigma, seed=1)
        near = turned(searched.vector, off, -off)
        followed = refine_epipoles(
            PointPairs.of(a, b), [near], views.sigma, limit=4.0 * views.sigma
        )[0]
        same = abs(followed.direction - searched.direction) < 0.2 * searched.direction_sd
        agreeing += same and (followed.inliers == searched.inliers).mean() > 0.95
    assert agreeing >= 17


def test_following_is_exact_without_noise_however_far_the_start() -> None:
    start = (0.2, -4.0, 0.05)
    world = World(start)
    views = world.views(start, 0.0)
    a, b = (rays[:, [0, 2]] / rays[:, 1:2] for rays in (views.current, views.target))
    exact = ransac_planar_epipoles(a, b, views.sigma, seed=1)
    followed = refine_epipoles(
        PointPairs.of(a, b),
        [turned(exact.vector, 0.003, -0.003)],
        views.sigma,
        limit=4.0 * views.sigma,
    )[0]
    assert followed.direction == pytest.approx(exact.direction, abs=1e-8)


@pytest.mark.parametrize("outliers", [0.0, 0.2])
def test_far_pairs_of_a_calibrated_perspective_camera_are_determined(outliers: float) -> None:
    """Driving ahead, most rays lie near the baseline and are noisy; together they tell."""
    errors = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        start = (rng.uniform(-1, 1), rng.uniform(-18, -2), rng.uniform(-0.2, 0.2))
        world = World(start, noise_px=0.5, seed=seed, outliers=outliers)
        views = world.views(start, 0.0)
        found = ransac_planar_motion(views.current, views.target, views.sigma, seed=1)
        assert found.determined, found.reason
        errors.append(abs(float(wrap_angle(found.direction - bearing_of((0, 0, 0), start)))))
    assert math.degrees(np.median(errors)) < 0.25


def _pair(world: World, start: Pose, seed: int):
    views = world.views(start, 0.0)
    a, b = (rays[:, [0, 2]] / rays[:, 1:2] for rays in (views.current, views.target))
    return ransac_planar_epipoles(a, b, 0.5 / PERSPECTIVE.fx, seed=seed)
