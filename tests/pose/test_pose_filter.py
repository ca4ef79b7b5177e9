"""The transfer filter against a general filter, finite differences and its own covariance."""

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from visctrl.geometry.trifocal.transfer import wrap_half_turn
from visctrl.robots.unicycle import step_exact
from visctrl.schemes.pose.schmidt_ekf import CORE, SchmidtEkf

Array = NDArray[np.float64]
COUNT = 9
NOISE = np.diag([0.01, 0.02]) ** 2


def _bearing(points: Array, pose: Array) -> Array:
    d = points - pose[:2]
    return np.arctan2(d[:, 0], d[:, 1]) + pose[2]


def _filter(seed: int) -> tuple[SchmidtEkf, Array, Array]:
    """Return a filter near the truth, the points and the true pose, in units of |C1|."""
    rng = np.random.default_rng(seed)
    beta, phi = rng.uniform(-0.6, 0.6, 2)
    initial = np.array([np.sin(beta), -np.cos(beta), phi])
    pose = initial + rng.normal(0.0, 0.15, 3)
    angle = rng.uniform(-np.pi, np.pi, COUNT)
    points = 1.8 * np.stack([np.sin(angle), np.cos(angle)], axis=-1) + [0.0, -0.5]
    truth = np.concatenate([pose, [beta, phi, 0.1], np.zeros(2 * COUNT)])
    A = rng.normal(0.0, 1.0, (len(truth), len(truth)))
    scale = np.concatenate([[0.01, 0.01, 0.01, 0.01, 0.01, 0.003], np.full(2 * COUNT, 0.004)])
    P = np.outer(scale, scale) * (A @ A.T / len(truth) + np.eye(len(truth)))
    x = truth + rng.multivariate_normal(np.zeros(len(truth)), 0.01 * P)
    theta1, theta3 = _bearing(points, initial), _bearing(points, np.zeros(3))
    return SchmidtEkf(x, P, theta1, theta3), points, pose


def _general(found: SchmidtEkf) -> ExtendedKalmanFilter:
    ekf = ExtendedKalmanFilter(dim_x=len(found.x), dim_z=COUNT)
    ekf.x, ekf.P, ekf.Q = found.x.copy(), found.P.copy(), np.zeros_like(found.P)
    return ekf


@pytest.mark.parametrize("seed", range(5))
def test_prediction_is_that_of_a_general_filter(seed: int) -> None:
    found, _, _ = _filter(seed)
    ekf = _general(found)
    F, Q, motion = found.transition(0.3, -0.2, 0.5, 0.08, NOISE)
    ekf.F[:3, :CORE] = F
    ekf.Q[:3, :3] = Q
    ekf.predict()
    found.advance(0.3, -0.2, 0.5, 0.08, NOISE)
    assert_allclose(found.P, ekf.P, rtol=1e-10, atol=1e-16)
    metric = step_exact([0.0, 0.0, ekf.x_prior[2] - motion[2]], 0.3, -0.2, 0.5, 0.08)
    assert_allclose(motion[:2], found.x[5] * metric[:2], atol=2e-3)


@pytest.mark.parametrize("seed", range(5))
def test_transition_is_the_derivative_of_the_motion(seed: int) -> None:
    found, _, _ = _filter(seed)
    F, Q, _ = found.transition(0.3, -0.2, 0.5, 0.08, NOISE)
    start, h = found.x.copy(), 1e-6

    def after(x: Array, v: float = 0.3, omega: float = -0.2) -> Array:
        found.x = x.copy()
        found.advance(v, omega, 0.5, 0.08, NOISE)
        return found.x[:3]

    for k in range(CORE):
        step = np.zeros_like(start)
        step[k] = h
        slope = (after(start + step) - after(start - step)) / (2 * h)
        assert_allclose(F[:, k], slope, atol=1e-8)
    G = np.stack(
        [
            (after(start, 0.3 + h) - after(start, 0.3 - h)) / (2 * h),
            (after(start, 0.3, -0.2 + h) - after(start, 0.3, -0.2 - h)) / (2 * h),
        ],
        axis=-1,
    )
    assert_allclose(Q, G @ NOISE @ G.T, rtol=1e-5, atol=1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_bearing_jacobian_is_the_derivative_of_the_prediction(seed: int) -> None:
    found, _, _ = _filter(seed)
    index = np.arange(COUNT)
    transfer = found.transfer(index)
    core, h, start = found.core_jacobian(transfer), 1e-6, found.x.copy()
    good = np.abs(transfer.parallax) > 0.1

    def slope(row: int) -> Array:
        ends = []
        for sign in (1.0, -1.0):
            found.x = start.copy()
            found.x[row] += sign * h
            ends.append(found.transfer(index).bearing)
        return wrap_half_turn(ends[0] - ends[1]) / (2 * h)

    for k in range(CORE):
        assert_allclose(core[k, good], slope(k)[good], rtol=1e-4, atol=1e-6)
    for feature in np.flatnonzero(good):
        by_first = slope(CORE + feature)[feature]
        by_third = slope(CORE + COUNT + feature)[feature]
        assert_allclose(-transfer.by_bearings[:, feature], [by_first, by_third], rtol=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_correction_is_that_of_a_general_filter(seed: int) -> None:
    found, points, pose = _filter(seed)
    ekf = _general(found)
    sigma = np.linspace(0.004, 0.008, COUNT)
    theta2 = _bearing(points, pose) + np.random.default_rng(seed).normal(0.0, sigma)
    index = np.arange(COUNT)
    transfer = found.transfer(index)
    H = np.zeros((COUNT, len(found.x)))
    H[:, :CORE] = found.core_jacobian(transfer).T
    H[index, CORE + index] = -transfer.by_bearings[0]
    H[index, CORE + COUNT + index] = -transfer.by_bearings[1]
    innovation = found.correct(index, theta2, sigma)
    used = innovation.used
    assert len(used) >= 5
    ekf.update(
        theta2[used],
        HJacobian=lambda x: H[used],
        Hx=lambda x: transfer.bearing[used],
        R=np.diag(sigma[used] ** 2),
        residual=lambda a, b: wrap_half_turn(a - b),
    )
    assert_allclose(found.x, ekf.x, rtol=1e-9, atol=1e-12)
    assert_allclose(found.P, ekf.P, rtol=1e-6, atol=1e-13)
    assert innovation.nis == pytest.approx(ekf.mahalanobis**2, rel=1e-9)
    assert innovation.dof == len(used)


def test_gross_errors_are_left_out() -> None:
    found, points, pose = _filter(1)
    theta2 = _bearing(points, pose)
    theta2[4] += 0.7
    innovation = found.correct(np.arange(COUNT), theta2, np.full(COUNT, 0.005))
    assert 4 not in innovation.used
    assert innovation.dof > 0


def test_metric_pose_and_covariance_follow_from_the_state() -> None:
    found, _, _ = _filter(2)
    rng = np.random.default_rng(0)
    draws = rng.multivariate_normal(found.x[:CORE], 1e-4 * found.P[:CORE, :CORE], 200_000)
    metric = np.stack([draws[:, 0] / draws[:, 5], draws[:, 1] / draws[:, 5], draws[:, 2]], axis=-1)
    assert_allclose(found.pose[:2], found.x[:2] / found.x[5])
    assert_allclose(1e-4 * found.covariance, np.cov(metric.T), rtol=0.03, atol=1e-9)
    assert np.hypot(*found.initial[:2]) == pytest.approx(1.0 / found.x[5])


def test_an_exchanged_feature_starts_from_its_prior() -> None:
    found, _, _ = _filter(3)
    before = found.P[:CORE, :CORE].copy()
    found.exchange(2, 0.3, -0.4, 0.01, 0.02)
    row, column = CORE + 2, CORE + COUNT + 2
    assert found.P[row, row] == pytest.approx(0.01**2)
    assert found.P[column, column] == pytest.approx(0.02**2)
    assert np.count_nonzero(found.P[row]) == np.count_nonzero(found.P[column]) == 1
    assert_allclose(found.P[:CORE, :CORE], before)
    assert found.theta1[2] == 0.3
