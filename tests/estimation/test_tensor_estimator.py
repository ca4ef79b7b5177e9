"""The tensor estimator: right elements and covariance, scale, and health for whatever comes."""

import math

import numpy as np
import pytest
from drives import PERIOD, SIGMA, Drive, context

from visctrl.contracts import Health
from visctrl.geometry.trifocal.tensor import (
    T121,
    normalised,
    target_in_view,
    tensor_from_poses,
)
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.schemes.trifocal.estimator import Tensor
from visctrl.schemes.trifocal.tensor_method import TensorOptions

START = (-0.55, -1.35, -0.45)
ONWARDS = Velocity(0.2, 0.05)
METHODS = ["constrained", "refined", "linear5", "linear7"]


def estimator(*, offset=0.0, limits=False, **options):
    return Tensor(TensorOptions(**options), context(offset=offset, limits=limits))


def follow(plugin, drive, ticks, velocity=ONWARDS, **views):
    """Drive on and return the last estimate; the first tick sees the start."""
    estimate = plugin.update(drive.views(**views), STANDSTILL, 0.0)
    for _ in range(ticks):
        drive.step(velocity)
        estimate = plugin.update(drive.views(**views), velocity, PERIOD)
    return estimate


def truth(drive):
    return tensor_from_poses(np.array(drive.start), drive.pose)


@pytest.mark.parametrize("method", METHODS)
def test_exact_views_give_the_exact_tensor(method):
    drive = Drive(START)
    estimate = follow(estimator(method=method), drive, 20)
    assert estimate.health is Health.OK
    np.testing.assert_allclose(estimate.elements, normalised(truth(drive)), atol=2e-5)
    assert estimate.phi_1 == pytest.approx(START[2], abs=1e-5)
    right, forward = target_in_view(drive.pose)
    assert estimate.bearing == pytest.approx(math.atan2(right, forward), abs=1e-4)
    assert estimate.heading == pytest.approx(drive.pose[2], abs=1e-4)
    assert -estimate.determinant == pytest.approx(estimate.target[1], abs=1e-9)


@pytest.mark.parametrize("method", ["constrained", "linear5"])
def test_metric_scale_from_what_was_driven(method):
    drive = Drive(START, sigma=1e-3)
    estimate = follow(estimator(method=method), drive, 10, Velocity(0.2, 0.0))
    metric = truth(drive)[T121]
    assert estimate.scale_m == pytest.approx(metric, rel=0.04)
    assert 0.0 < estimate.scale_sd_m < 0.1 * metric
    assert estimate.distance_m == pytest.approx(math.hypot(*drive.pose[:2]), rel=0.04)


def test_scale_sees_through_ramp_and_delay():
    """What is sent acts 0.1 s late and ramped at 0.3 m/s²; the scale stays right to 2 %."""
    drive, plugin = Drive(START, sigma=5e-4), estimator(limits=True)
    estimate = plugin.update(drive.views(), STANDSTILL, 0.0)
    speed, pending = 0.0, [0.0]
    for _ in range(20):
        pending.append(0.2)
        wanted = pending.pop(0)
        for _ in range(10):
            speed += max(-0.003, min(0.003, wanted - speed))
            drive.step(Velocity(speed, 0.0), PERIOD / 10)
        estimate = plugin.update(drive.views(), Velocity(0.2, 0.0), PERIOD)
    assert estimate.scale_m == pytest.approx(truth(drive)[T121], rel=0.02)


def test_a_given_scale_and_heading_are_taken():
    drive = Drive(START)
    options = {"scale": "given", "scale_m": 10.0, "phi_1": "given", "phi_1_deg": 5.0}
    estimate = follow(estimator(**options), drive, 10)
    assert estimate.scale_m == 10.0
    assert estimate.scale_sd_m == math.inf
    assert estimate.phi_1 == pytest.approx(math.radians(5.0))
    assert follow(estimator(phi_1="zero"), Drive(START), 5).phi_1 == 0.0


def test_a_heading_that_is_told_is_known_where_the_views_bear_it_out():
    true = START[2]
    for told, known in ((true, True), (true + math.radians(10.0), False)):
        seen = follow(estimator(phi_1="given", phi_1_deg=math.degrees(told)), Drive(START), 5)
        assert seen.phi_1 == pytest.approx(told)
        assert (seen.phi_1_sd == 0.0) is known
        assert math.isfinite(seen.phi_1_sd) is known


@pytest.mark.parametrize("method", ["constrained", "refined"])
def test_covariance_is_consistent(method):
    """Normalised squared errors are χ²: their median per unknown is 0.87 for five."""
    ratios = []
    for seed in range(40):
        drive, plugin = Drive(START, seed=seed, sigma=SIGMA), estimator(method=method)
        plugin.update(drive.views(), STANDSTILL, 0.0)
        for _ in range(20):
            drive.step(ONWARDS)
        estimate = plugin.update(drive.views(), ONWARDS, 20 * PERIOD)
        error = estimate.elements - normalised(truth(drive))
        inverse = np.linalg.pinv(estimate.covariance, rcond=1e-9)
        ratios.append(error @ inverse @ error / 5.0)
    assert 0.5 < np.median(ratios) < 1.5
    assert np.quantile(ratios, 0.9) < 6.0


def test_constrained_beats_linear_by_far():
    errors = {}
    for method in ("constrained", "linear5"):
        worst = []
        for seed in range(15):
            drive = Drive(START, seed=seed, sigma=SIGMA)
            estimate = follow(estimator(method=method), drive, 12, outliers=6)
            worst.append(np.abs(estimate.elements - normalised(truth(drive))).max())
        errors[method] = np.median(worst)
    assert errors["constrained"] < 0.006
    assert errors["constrained"] < 0.3 * errors["linear5"]


def test_a_third_of_the_features_wrong():
    drive = Drive(START, sigma=1e-3)
    estimate = follow(estimator(), drive, 20, outliers=20)
    assert estimate.health is Health.OK
    np.testing.assert_allclose(estimate.elements, normalised(truth(drive)), atol=0.01)


def test_a_view_that_jumps_is_found_again():
    """Features lost for two seconds of driving: the fit recovers from a far-off prediction."""
    drive, plugin = Drive(START, sigma=1e-3), estimator()
    follow(plugin, drive, 10)
    for _ in range(20):
        drive.step(ONWARDS)
    estimate = plugin.update(drive.views(outliers=10), STANDSTILL, PERIOD)
    assert estimate.health is Health.OK
    np.testing.assert_allclose(estimate.elements, normalised(truth(drive)), atol=0.01)


def test_at_the_target_the_outputs_vanish_whatever_the_initial_view():
    """The stopping point does not depend on φ1 or the baseline's direction being right."""
    drive = Drive(START, sigma=SIGMA)
    plugin = estimator()
    follow(plugin, drive, 3)
    drive.pose = np.array([0.0, 0.0, 0.2])
    plugin.update(drive.views(), STANDSTILL, PERIOD)
    drive.pose = np.zeros(3)
    estimate = plugin.update(drive.views(), STANDSTILL, PERIOD)
    assert np.abs(estimate.outputs).max() < 5e-3
    assert abs(estimate.heading) < math.radians(0.15)


def test_beyond_a_right_angle_the_sign_is_known():
    """T121 changes its sign with the heading; distance, bearing and heading do not jump."""
    drive, plugin = Drive((0.2, -1.5, 0.0)), estimator()
    follow(plugin, drive, 5, Velocity(0.2, 0.0))
    for _ in range(44):
        drive.step(Velocity(0.0, 0.5))
        estimate = plugin.update(drive.views(), Velocity(0.0, 0.5), PERIOD)
    assert drive.pose[2] > math.radians(100.0)
    assert estimate.scale_m < 0.0
    assert estimate.heading == pytest.approx(drive.pose[2], abs=1e-3)
    right, forward = target_in_view(drive.pose)
    assert estimate.bearing == pytest.approx(math.atan2(right, forward), abs=1e-2)


@pytest.mark.parametrize("method", METHODS)
def test_no_features_are_lost_and_numbers_stay_finite(method):
    drive, plugin = Drive(START), estimator(method=method)
    assert plugin.update(drive.nothing(), STANDSTILL, 0.0).health is Health.LOST
    before = follow(plugin, drive, 10)
    lost = plugin.update(drive.nothing(), ONWARDS, PERIOD)
    assert lost.health is Health.LOST
    assert lost.reason == "dark"
    np.testing.assert_array_equal(lost.elements, before.elements)
    assert plugin.values() == {}
    few = plugin.update(drive.views(keep=slice(0, 5)), ONWARDS, PERIOD)
    assert few.health is Health.LOST
    assert "5 features" in few.reason


@pytest.mark.parametrize("method", ["linear5", "linear7", "refined"])
def test_identical_initial_and_current_views_are_named(method):
    drive = Drive(START, sigma=SIGMA)
    estimate = estimator(method=method).update(drive.views(), STANDSTILL, 0.0)
    assert estimate.health is Health.DEGENERATE
    assert estimate.reason == "views identical: initial and current"


def test_features_that_agree_on_nothing_are_named():
    drive, plugin = Drive(START, sigma=1e-3), estimator()
    follow(plugin, drive, 10)
    views = drive.views(outliers=60)
    estimate = plugin.update(views, ONWARDS, PERIOD)
    assert estimate.health is Health.DEGENERATE
    assert "features disagree" in estimate.reason


def test_a_robot_on_the_target_knows_its_heading():
    drive = Drive((0.0, 0.0, 0.7), sigma=SIGMA)
    estimate = estimator().update(drive.views(), STANDSTILL, 0.0)
    assert estimate.health is Health.OK
    assert np.abs(estimate.outputs).max() < 1e-9
    assert estimate.heading == pytest.approx(0.7, abs=math.radians(0.2))


@pytest.mark.parametrize("method", METHODS)
def test_random_rays_never_raise(method):
    rng = np.random.default_rng(0)
    plugin = estimator(method=method)
    drive = Drive(START)
    for count in (8, 12, 60):
        for _ in range(5):
            views = drive.views(keep=slice(0, count))
            noise = rng.normal(size=(3, count, 3))
            noise /= np.linalg.norm(noise, axis=-1, keepdims=True)
            garbage = type(views)(
                ids=views.ids,
                target=noise[0],
                initial=noise[1],
                current=noise[2],
                pixels=views.pixels,
                sigma=SIGMA,
                stamp=0.0,
            )
            estimate = plugin.update(garbage, ONWARDS, PERIOD)
            assert np.isfinite(estimate.elements).all()
            assert np.isfinite(estimate.covariance).all()


def test_every_signal_is_reported():
    plugin = estimator()
    follow(plugin, Drive(START), 5)
    assert set(plugin.values()) == {signal.name for signal in plugin.signals}
    assert all(math.isfinite(value) for value in plugin.values().values())


def test_reset_forgets():
    drive, plugin = Drive(START), estimator()
    follow(plugin, drive, 10)
    plugin.reset()
    again = Drive((0.4, -1.6, 0.2), seed=1)
    estimate = follow(plugin, again, 10)
    np.testing.assert_allclose(estimate.elements, normalised(truth(again)), atol=2e-5)


def test_same_views_same_bits():
    first, second = (
        follow(estimator(), Drive(START, sigma=SIGMA), 10, outliers=10) for _ in range(2)
    )
    np.testing.assert_array_equal(first.elements, second.elements)
    assert first.scale_m == second.scale_m
