"""The initial view: from elevations, from bearings alone, and when the former are wrong."""

import math

import numpy as np
import pytest
from drives import PERIOD, SIGMA, Drive, context

from visctrl.contracts import Health
from visctrl.geometry.trifocal.fit import coupling, refine
from visctrl.geometry.trifocal.tensor import target_in_view, trilinear
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.schemes.trifocal.estimator import Tensor
from visctrl.schemes.trifocal.initial_view import InitialView, InitialViewFilter
from visctrl.schemes.trifocal.tensor_method import TensorOptions

START = (-0.55, -1.35, -0.35)
CURVE = Velocity(0.25, -0.1)


def follow(plugin, drive, ticks, distort=lambda views: views):
    estimate = plugin.update(distort(drive.views()), STANDSTILL, 0.0)
    for _ in range(ticks):
        drive.step(CURVE)
        estimate = plugin.update(distort(drive.views()), CURVE, PERIOD)
    return estimate


def with_wrong_elevations(factor):
    """Views of a camera with a wrong ξ or focal length: elevations stretched, bearings right."""

    def stretched(rays):
        rays = rays * [1.0, 1.0, factor] + [0.0, 0.0, 0.05]
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def distort(views):
        fields = {
            name: stretched(getattr(views, name)) for name in ("target", "initial", "current")
        }
        return type(views)(**{**views.__dict__, **fields})

    return distort


def true_view(drive):
    right, forward = target_in_view(np.array(drive.start))
    return drive.start[2], math.atan2(right, forward)


def test_bearings_alone_find_the_initial_view_on_the_way():
    drive = Drive(START, sigma=1e-3)
    plugin = Tensor(TensorOptions(elevations=False), context())
    first = plugin.update(drive.views(), STANDSTILL, 0.0)
    assert first.health is Health.DEGENERATE
    assert "the robot has to move" in first.reason
    estimate = follow(plugin, drive, 35)
    assert estimate.health is Health.OK
    assert abs(estimate.phi_1 - START[2]) < math.radians(1.0)
    assert estimate.phi_1_sd < math.radians(1.0)
    assert abs(estimate.heading - drive.pose[2]) < math.radians(1.0)


def test_level_features_do_without_elevations():
    """All features at the camera's height: the essential matrix is silent, bearings are not."""
    drive = Drive(START, sigma=1e-3, level=True)
    estimate = follow(Tensor(TensorOptions(), context()), drive, 35)
    assert estimate.health is Health.OK
    assert abs(estimate.phi_1 - START[2]) < math.radians(1.0)


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_bearings_overrule_wrong_elevations(factor):
    drive = Drive(START, sigma=1e-3)
    plugin = Tensor(TensorOptions(), context())
    distort = with_wrong_elevations(factor)
    before = plugin.update(distort(drive.views()), STANDSTILL, 0.0)
    estimate = follow(plugin, drive, 40, distort)
    wrong, right = (abs(e.phi_1 - START[2]) for e in (before, estimate))
    assert wrong > math.radians(1.0)
    assert right < 0.4 * wrong


def test_right_elevations_are_trusted():
    """The bearings' weaker knowledge does not spoil a prior that it does not contradict."""
    errors = []
    for seed in range(10):
        drive = Drive(START, seed=seed, sigma=SIGMA)
        estimate = follow(Tensor(TensorOptions(), context()), drive, 30)
        errors.append(abs(estimate.phi_1 - START[2]))
    assert np.median(errors) < math.radians(0.15)


def test_filter_without_prior_converges_to_the_truth():
    drive = Drive(START, sigma=1e-4)
    phi, bearing = true_view(drive)
    guess = InitialView(phi + 0.03, bearing - 0.03, np.diag([np.inf, np.inf]))
    known = InitialViewFilter(guess)
    view = guess.parameters
    for _ in range(45):
        drive.step(CURVE)
        seen = drive.views()
        relation = trilinear(seen.initial, seen.current, seen.target)
        fit = refine(relation.within(known.view.basis), view, seen.sigma)
        view = fit.z
        known.update(coupling(relation, fit, known.view.parameters, known.view.jacobian))
    assert known.view.phi == pytest.approx(phi, abs=math.radians(0.3))
    assert known.view.bearing == pytest.approx(bearing, abs=math.radians(0.3))
    assert np.isfinite(known.view.covariance).all()


def test_many_frames_do_not_make_the_fixed_views_certain():
    """Noise of the initial and target views stays, however often the current one is taken."""
    drive = Drive(START, sigma=SIGMA)
    phi, bearing = true_view(drive)
    known = InitialViewFilter(InitialView(phi, bearing, np.diag([np.inf, np.inf])))
    for _ in range(20):
        drive.step(CURVE)
    deviations = []
    for _ in range(60):
        seen = drive.views()
        relation = trilinear(seen.initial, seen.current, seen.target)
        fit = refine(relation.within(known.view.basis), known.view.parameters, seen.sigma)
        known.update(coupling(relation, fit, known.view.parameters, known.view.jacobian))
        deviations.append(math.sqrt(known.view.covariance[0, 0]))
    assert deviations[-1] > 0.6 * deviations[0]


def test_jacobian_by_finite_differences():
    step = 1e-6
    view = InitialView(0.3, -0.2, np.eye(2))
    for k, shift in enumerate(np.eye(2) * step):
        ahead = InitialView(0.3 + shift[0], -0.2 + shift[1], np.eye(2)).parameters
        behind = InitialView(0.3 - shift[0], -0.2 - shift[1], np.eye(2)).parameters
        np.testing.assert_allclose(view.jacobian[:, k], (ahead - behind) / (2 * step), atol=1e-9)
