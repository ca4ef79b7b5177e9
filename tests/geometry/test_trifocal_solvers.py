"""Linear and minimal solvers, RANSAC, refinement: against the closed form and its noise."""

import time

import numpy as np
import pytest
from three_views import TARGET, random_poses, rays_seen, scene

from visctrl.geometry.trifocal import fit as trifocal_fit
from visctrl.geometry.trifocal import tensor as trifocal
from visctrl.geometry.trifocal.solvers import (
    identical_views,
    linear_covariance,
    ransac_tensor,
    solve_linear,
    solve_minimal,
)
from visctrl.geometry.trifocal.tensor import CALIBRATED, UNCALIBRATED

INITIAL, CURRENT = np.array([-0.55, -1.35, -0.6]), np.array([-0.3, -0.7, -0.5])
SIGMA = 2e-3


def seen(seed, count, sigma=0.0, outliers=0, current=CURRENT):
    rng = np.random.default_rng(seed)
    points = scene(rng, count)
    views = [rays_seen(points, pose, rng, sigma) for pose in (INITIAL, current, TARGET)]
    views[1][:outliers] = rays_seen(scene(rng, outliers), current)
    return trifocal.trilinear(*views)


def truth(current=CURRENT):
    return trifocal.normalised(trifocal.tensor_from_poses(INITIAL, current))


def view_1():
    target = trifocal.target_in_view(INITIAL)
    return trifocal.view_parameters(INITIAL[2], target / np.linalg.norm(target))


@pytest.mark.parametrize(
    ("basis", "count"),
    [(UNCALIBRATED, 7), (UNCALIBRATED, 20), (CALIBRATED, 5), (CALIBRATED, 20)],
)
def test_linear_solution_is_the_closed_form(basis, count):
    relation = seen(0, count).within(basis)
    T = basis @ solve_linear(relation)
    np.testing.assert_allclose(trifocal.normalised(T), truth(), atol=1e-6)


@pytest.mark.parametrize("basis", [UNCALIBRATED, CALIBRATED, trifocal.current_view_basis(view_1())])
def test_minimal_samples_in_one_batch(basis):
    unknowns = basis.shape[1]
    relation = seen(1, 60).within(basis)
    rng = np.random.default_rng(0)
    sample = np.stack([rng.permutation(60)[: unknowns - 1] for _ in range(40)])
    tensors = solve_minimal(relation.error[sample]) @ basis.T
    worst = np.abs(trifocal.normalised(tensors) - truth()).max(axis=1)
    # A sample may be ill-conditioned by bad luck; most are not.
    assert np.median(worst) < 1e-8


def test_linear_solver_broadcasts():
    relations = [seen(k, 12) for k in range(4)]
    stacked = trifocal.Trilinear(np.stack([r.forms for r in relations], axis=2)).within(CALIBRATED)
    T = trifocal.normalised(solve_linear(stacked) @ CALIBRATED.T)
    np.testing.assert_allclose(T, np.broadcast_to(truth(), (4, 8)), atol=1e-6)


@pytest.mark.parametrize("basis", [CALIBRATED, trifocal.current_view_basis(view_1())])
def test_ransac_finds_the_outliers(basis):
    for seed in range(5):
        relation = seen(seed, 60, SIGMA, outliers=18)
        _, inliers = ransac_tensor(relation.within(basis), SIGMA, seed=seed)
        assert inliers[18:].mean() > 0.85
        assert inliers[:18].mean() < 0.35


def test_ransac_is_repeatable():
    relation = seen(2, 60, SIGMA, outliers=18).within(CALIBRATED)
    first, second = (ransac_tensor(relation, SIGMA, seed=7)[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_ransac_refuses_too_few_features():
    with pytest.raises(ValueError, match="6 are needed"):
        ransac_tensor(seen(0, 5).within(CALIBRATED), SIGMA)


def test_five_hundred_hypotheses_are_quick():
    relation = seen(2, 60, SIGMA).within(CALIBRATED)
    best = np.inf
    for _ in range(15):
        start = time.perf_counter()
        ransac_tensor(relation, SIGMA, hypotheses=500)
        best = min(best, time.perf_counter() - start)
    assert best <= 0.010


@pytest.mark.parametrize("basis", [UNCALIBRATED, CALIBRATED])
@pytest.mark.parametrize("method", ["linear", "refined"])
def test_covariances_are_consistent(basis, method):
    """Normalised squared errors of Monte Carlo runs average their degrees of freedom."""
    ratios = []
    for seed in range(60):
        relation = seen(seed, 80, SIGMA).within(basis)
        z = solve_linear(relation)
        covariance = linear_covariance(relation, z, SIGMA)
        if method == "refined":
            fit = trifocal_fit.refine(relation, z, SIGMA)
            z, covariance = fit.z, fit.covariance
        T = basis @ z
        spread = trifocal.normalised_covariance(T, basis @ covariance @ basis.T)
        error = trifocal.normalised(T) - truth()
        ratios.append(error @ np.linalg.pinv(spread, rcond=1e-10) @ error / (basis.shape[1] - 1))
    assert 0.7 < np.mean(ratios) < 1.4


def test_refinement_beats_the_linear_solution():
    linear, refined = [], []
    for seed in range(40):
        relation = seen(seed, 60, SIGMA).within(CALIBRATED)
        z = solve_linear(relation)
        fit = trifocal_fit.refine(relation, z, SIGMA)
        linear.append(np.abs(trifocal.normalised(CALIBRATED @ z) - truth()).max())
        refined.append(np.abs(trifocal.normalised(CALIBRATED @ fit.z) - truth()).max())
    assert np.median(refined) < 0.8 * np.median(linear)


def test_knowing_the_initial_view_halves_the_error():
    basis = trifocal.current_view_basis(view_1())
    free, known = [], []
    for seed in range(40):
        relation = seen(seed, 60, SIGMA, outliers=18)
        for family, errors in ((CALIBRATED, free), (basis, known)):
            within = relation.within(family)
            z, inliers = ransac_tensor(within, SIGMA, seed=seed)
            fit = trifocal_fit.refine(within.take(inliers), z, SIGMA)
            errors.append(np.abs(trifocal.normalised(family @ fit.z) - truth()).max())
    assert np.median(known) < 0.5 * np.median(free)
    assert np.max(known) < 0.02


def test_refinement_starts_from_afar():
    """The start is the initial view: 0.7 m and 6 degrees off, and some features are wrong."""
    basis = trifocal.current_view_basis(view_1())
    for seed in range(20):
        relation = seen(seed, 60, SIGMA, outliers=3)
        fit = trifocal_fit.refine(relation.within(basis), view_1(), SIGMA)
        np.testing.assert_allclose(trifocal.normalised(basis @ fit.z), truth(), atol=0.02)
        assert not (np.abs(fit.residuals[:3]) < 3.0 * fit.spread).all()


def test_a_drift_wider_than_promised_does_not_mislead():
    """Half of the tracks drift by 0.4 degrees, the promised noise being 0.03 degrees."""
    basis = trifocal.current_view_basis(view_1())
    for seed in range(10):
        rng = np.random.default_rng(seed)
        points = scene(rng, 60)
        views = [rays_seen(points, pose, rng, 5e-4) for pose in (INITIAL, CURRENT, TARGET)]
        drift = np.where(np.arange(60) < 30, np.radians(0.4), 0.0) * rng.normal(size=60)
        views[1][:, 0], views[1][:, 1] = (
            views[1][:, 0] + drift * views[1][:, 1],
            views[1][:, 1] - drift * views[1][:, 0],
        )
        fit = trifocal_fit.refine(trifocal.trilinear(*views).within(basis), view_1(), 5e-4)
        heading, target = trifocal_fit.view_of(fit.z)
        assert abs(heading - CURRENT[2]) < np.radians(0.3)
        metric = np.array(target) * np.hypot(*INITIAL[:2])
        np.testing.assert_allclose(metric, trifocal.target_in_view(CURRENT), atol=0.02)


def test_view_jacobian_by_finite_differences():
    z = np.array([0.8, -0.5, 0.3, 1.1])
    step = 1e-6
    for k, axis in enumerate(np.eye(4)):
        (phi_a, t_a), (phi_b, t_b) = (trifocal_fit.view_of(z + s * axis) for s in (step, -step))
        slope = np.array([phi_a - phi_b, *np.subtract(t_a, t_b)]) / (2 * step)
        np.testing.assert_allclose(trifocal_fit.view_jacobian(z)[:, k], slope, atol=1e-8)


def test_sensitivity_to_the_initial_view_by_refitting():
    """dz/dq predicts how the fit moves when φ1 is changed a little."""
    relation = seen(3, 200, 5e-4)
    p1 = view_1()
    phi = INITIAL[2]
    jacobian = np.array([[-np.sin(phi)], [np.cos(phi)], [0.0], [0.0]])
    fit = trifocal_fit.refine(relation.within(trifocal.current_view_basis(p1)), p1, 5e-4)
    predicted = trifocal_fit.coupling(relation, fit, p1, jacobian).sensitivity[:, 0]
    step = 5e-3
    moved = []
    for sign in (1.0, -1.0):
        basis = trifocal.current_view_basis(
            np.array([np.cos(phi + sign * step), np.sin(phi + sign * step), *p1[2:]])
        )
        moved.append(trifocal_fit.refine(relation.within(basis), fit.z, 5e-4).z)
    np.testing.assert_allclose(predicted, (moved[0] - moved[1]) / (2 * step), rtol=0.1, atol=0.02)


def test_coupling_leads_back_to_the_true_initial_view():
    """A fit made with φ1 wrong by 2 degrees says by how much it is wrong."""
    relation = seen(3, 200, 5e-4)
    target = view_1()[2:]
    phi = INITIAL[2] + np.radians(2.0)
    for _ in range(4):
        p1 = trifocal.view_parameters(phi, target)
        jacobian = np.array([[-np.sin(phi)], [np.cos(phi)], [0.0], [0.0]])
        fit = trifocal_fit.refine(relation.within(trifocal.current_view_basis(p1)), p1, 5e-4)
        coupled = trifocal_fit.coupling(relation, fit, p1, jacobian)
        phi += coupled.gradient[0] / coupled.information[0, 0]
    deviation = coupled.information[0, 0] ** -0.5
    assert np.degrees(deviation) < 0.2
    assert abs(phi - INITIAL[2]) < 3.0 * deviation


def test_views_that_only_turn_are_identical():
    rng = np.random.default_rng(0)
    points = scene(rng, 60)
    turned = INITIAL + np.array([0.0, 0.0, 0.7])
    a, b = (rays_seen(points, pose, rng, SIGMA) for pose in (INITIAL, turned))
    assert identical_views(a, b, SIGMA)
    moved = rays_seen(points, INITIAL + np.array([0.0, 0.2, 0.7]), rng, SIGMA)
    assert not identical_views(a, moved, SIGMA)


def test_random_scenes_and_poses():
    for seed in range(30):
        rng = np.random.default_rng(seed)
        initial, current = random_poses(rng)
        points = scene(rng, 30)
        relation = trifocal.trilinear(
            *(rays_seen(points, pose) for pose in (initial, current, TARGET))
        )
        expected = trifocal.normalised(trifocal.tensor_from_poses(initial, current))
        T = CALIBRATED @ solve_linear(relation.within(CALIBRATED))
        np.testing.assert_allclose(trifocal.normalised(T), expected, atol=1e-5)
