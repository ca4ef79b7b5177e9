"""Planar motion of two views: accuracy, consistency, signs, outliers, degeneracies by name."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from three_views import rays_seen, scene

from visctrl.geometry.two_view.parallax import signed_parallax
from visctrl.geometry.two_view.planar import (
    ransac_planar_motion,
    refine_motions,
    refine_planar_motion,
    sampson_residuals,
)
from visctrl.geometry.two_view.planar_fit import RayPairs
from visctrl.robots.unicycle import wrap_angle

SIGMA = 2e-3
angles = st.floats(-3.0, 3.0)


def pair(seed, baseline, direction, phi, count=60, sigma=0.0, outliers=0):
    rng = np.random.default_rng(seed)
    points = scene(rng, count)
    pose = np.array([baseline * np.sin(direction), baseline * np.cos(direction), phi])
    a, b = rays_seen(points, np.zeros(3), rng, sigma), rays_seen(points, pose, rng, sigma)
    b[:outliers] = rays_seen(scene(rng, outliers), pose)
    return a, b


def essential_matrix(phi: float, direction: float) -> np.ndarray:
    """E (3, 3) with aᵀ E b = 0 for a motion (rad)."""
    alpha = direction + phi
    c, s, c_b, s_b = np.cos(direction), np.sin(direction), np.cos(alpha), np.sin(alpha)
    return np.array([[0.0, 0.0, c], [0.0, 0.0, -s], [-c_b, s_b, 0.0]])


@given(angles, angles)
@settings(max_examples=40)
def test_true_rays_fulfil_the_essential_matrix(direction, phi):
    a, b = pair(0, 0.7, direction, phi)
    error = np.einsum("ni,ij,nj->n", a, essential_matrix(phi, direction), b)
    assert np.abs(error).max() < 1e-12
    residual, _ = sampson_residuals(a, b, phi, direction)
    assert np.abs(residual).max() < 1e-9


@given(angles, angles)
@settings(max_examples=40)
def test_exact_motion_and_its_sign(direction, phi):
    a, b = pair(1, 0.5, direction, phi)
    motion = ransac_planar_motion(a, b, 1e-4)
    assert motion.determined
    assert abs(wrap_angle(motion.phi - phi)) < 1e-6
    assert abs(wrap_angle(motion.direction - direction)) < 1e-5
    assert motion.inliers.all()
    assert (signed_parallax(a, b, motion.phi, motion.direction) > 0.0).all()


def test_jacobian_by_finite_differences():
    a, b = pair(2, 0.5, 0.4, -0.3, sigma=0.02)
    _, jacobian = sampson_residuals(a, b, -0.25, 0.5)
    step = 1e-6
    for k, shift in enumerate(np.eye(2) * step):
        ahead, _ = sampson_residuals(a, b, -0.25 + shift[0], 0.5 + shift[1])
        behind, _ = sampson_residuals(a, b, -0.25 - shift[0], 0.5 - shift[1])
        np.testing.assert_allclose(jacobian[:, k], (ahead - behind) / (2 * step), atol=1e-6)


@pytest.mark.parametrize(("baseline", "direction_deg"), [(2.0, 0.4), (0.5, 1.6), (0.1, 7.0)])
def test_accuracy_and_consistency_with_outliers(baseline, direction_deg):
    errors, nees = [], []
    for seed in range(60):
        rng = np.random.default_rng(1000 + seed)
        direction, phi = rng.uniform(-np.pi, np.pi), rng.uniform(-1.0, 1.0)
        a, b = pair(seed, baseline, direction, phi, 60, SIGMA, outliers=18)
        motion = ransac_planar_motion(a, b, SIGMA, seed=seed)
        error = wrap_angle(np.array([motion.phi - phi, motion.direction - direction]))
        errors.append(np.degrees(np.abs(error)))
        if motion.determined:
            nees.append(error @ np.linalg.solve(motion.covariance, error) / 2.0)
    phi_95, direction_95 = np.quantile(errors, 0.95, axis=0)
    assert phi_95 < 0.3
    assert direction_95 < direction_deg
    # The median of χ² with two degrees of freedom, per degree, is 0.69.
    assert 0.35 < np.median(nees) < 1.1
    assert len(nees) > 50


def test_turn_stays_accurate_as_the_baseline_vanishes():
    """0.11 degrees of noise: φ to 0.2 degrees at any baseline, and no claim of a direction."""
    for baseline in (0.02, 0.01, 0.003, 0.0):
        errors, known = [], 0
        for seed in range(25):
            a, b = pair(seed, baseline, 0.3, 0.5, 60, SIGMA, outliers=12)
            motion = ransac_planar_motion(a, b, SIGMA, seed=seed)
            errors.append(abs(motion.phi - 0.5))
            known += motion.determined
            if motion.found and not motion.determined:
                assert motion.reason.startswith("views identical")
                assert np.isfinite(motion.phi_sd)
                assert motion.direction_sd > 1.0
        assert np.degrees(np.quantile(errors, 0.95)) < 0.25
        assert known <= (3 if baseline > 0.01 else 1)


def test_a_quiet_sensor_sees_a_short_baseline():
    a, b = pair(0, 0.01, 0.3, 0.5, 200, 1e-4)
    motion = ransac_planar_motion(a, b, 1e-4)
    assert motion.determined
    assert abs(motion.direction - 0.3) < 5.0 * motion.direction_sd < 0.2


def test_warm_start_follows_a_motion():
    a, b = pair(3, 1.0, 0.3, 0.5, 80, SIGMA)
    cold = ransac_planar_motion(a, b, SIGMA)
    # The opposite direction is the same essential matrix; the sign is found anew.
    for start in ((0.45, 0.35), (0.45, 0.35 + np.pi)):
        warm = refine_planar_motion(a, b, *start, SIGMA)
        assert warm.phi == pytest.approx(cold.phi, abs=2e-3)
        assert warm.direction == pytest.approx(cold.direction, abs=5e-3)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_features_are_lost(count):
    rays = np.tile([0.0, 1.0, 0.0], (count, 1))
    motion = ransac_planar_motion(rays, rays, SIGMA)
    assert not motion.found
    assert "too few features" in motion.reason
    assert motion.inliers.shape == (count,)


def test_features_level_with_the_camera_say_nothing():
    rng = np.random.default_rng(0)
    points = scene(rng, 60) * [1.0, 1.0, 0.0]
    a = rays_seen(points, np.zeros(3), rng, SIGMA)
    b = rays_seen(points, np.array([0.3, 0.4, 0.2]), rng, SIGMA)
    motion = ransac_planar_motion(a, b, SIGMA)
    assert not motion.determined


def test_clustered_features_are_degenerate():
    """Everything within 2 degrees, far away: turning and moving look alike."""
    rng = np.random.default_rng(0)
    points = np.array([0.0, 30.0, 2.0]) + rng.normal(scale=0.3, size=(40, 3))
    a = rays_seen(points, np.zeros(3), rng, SIGMA)
    b = rays_seen(points, np.array([0.3, 0.1, 0.0]), rng, SIGMA)
    motion = ransac_planar_motion(a, b, SIGMA)
    assert motion.found
    assert not motion.determined


def test_features_all_in_one_place_say_nothing():
    rng = np.random.default_rng(0)
    for _ in range(50):
        a, b = rays_seen(scene(rng, 1), np.zeros(3)), rays_seen(scene(rng, 1), np.zeros(3))
        start = rng.normal(size=2)
        motion = refine_planar_motion(np.repeat(a, 6, 0), np.repeat(b, 6, 0), *start, SIGMA)
        assert not motion.determined


@pytest.mark.parametrize("limit_sigmas", [np.inf, 8.0])
def test_motions_refined_together_are_those_refined_alone(limit_sigmas):
    """Bit by bit: of other rays, noise, features and starts, so that some need more steps."""
    rng = np.random.default_rng(8)
    sigmas = np.geomspace(1e-3, 8e-3, 9)
    views = [pair(k, 0.7, 0.5, 0.3, sigma=sigma) for k, sigma in enumerate(sigmas.tolist())]
    a, b = (np.array([each[side].T for each in views]) for side in (0, 1))
    starts = (np.array([0.3, 0.5]) + rng.normal(size=(9, 2)) * 0.02).tolist()
    present = rng.random((9, 60)) > 0.1
    options = {"limit_sigmas": limit_sigmas}
    together = refine_motions(RayPairs(a, b), starts, sigmas, present=present, **options)
    for k, motion in enumerate(together):
        one, here = slice(k, k + 1), present[k]
        pairs = RayPairs(a[one], b[one])
        (alone,) = refine_motions(pairs, starts[one], sigmas[k], present=present[one], **options)
        assert (motion.phi, motion.direction) == (alone.phi, alone.direction)
        np.testing.assert_array_equal(motion.covariance, alone.covariance)
        np.testing.assert_array_equal(motion.inliers, alone.inliers)
        # Features that are absent might as well not be there.
        pairs = RayPairs(a[one][..., here], b[one][..., here])
        (fewer,) = refine_motions(pairs, starts[one], sigmas[k], **options)
        np.testing.assert_allclose(motion.covariance, fewer.covariance, rtol=1e-9)
        np.testing.assert_array_equal(motion.inliers[here], fewer.inliers)


def test_same_seed_same_bits():
    a, b = pair(4, 1.0, 0.3, 0.5, 60, SIGMA, outliers=18)
    first, second = (ransac_planar_motion(a, b, SIGMA, seed=5) for _ in range(2))
    assert (first.phi, first.direction) == (second.phi, second.direction)
