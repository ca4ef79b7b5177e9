"""The 2D tensor scheme: estimator and control in closed loop, and where it must fail."""

import math
from dataclasses import replace

import numpy as np
import pytest
from closed_loop import LARGE, REAL, Loop

from visctrl.contracts import Health
from visctrl.geometry.trifocal.tensor2d import (
    T221,
    T223,
    normalised_2d,
    tensor_2d_from_poses,
)
from visctrl.hal.mock.backend import MockOptions
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.schemes.trifocal2d.estimator import Tensor2d, Tensor2dOptions
from visctrl.schemes.trifocal2d.law import Trifocal2d, Trifocal2dOptions

START = (-0.55, -1.35, -35.0)


def run(start, mock, duration=40.0, estimator=None, seed=0, **options):
    loop = Loop(start, mock, LARGE, seed=seed)
    return loop._run(
        Tensor2d(estimator or Tensor2dOptions(), loop.context),
        Trifocal2d(Trifocal2dOptions(**options), loop.context),
        duration,
    )


def test_reaches_the_target_without_noise():
    outcome = run(START, MockOptions(ideal=True))
    assert outcome.finished
    assert outcome.position < 1e-3
    assert outcome.heading_deg < 0.1


def test_a_straight_way_keeps_its_scale_at_the_target():
    """Straight to the end: where the baseline's direction is lost, the scale must not follow."""
    outcome = run((0.0, -2.0, 0.0), MockOptions(ideal=True))
    assert outcome.finished
    assert outcome.position < 1e-3


def test_reaches_the_target_with_a_real_base():
    mock = MockOptions(noise_px=0.3, near_m=1.5, far_m=5.0, actuation=REAL)
    outcome = run(START, mock)
    assert outcome.finished
    assert outcome.position < 0.05
    assert outcome.heading_deg < 1.0


def test_direct_references_end_in_a_local_minimum():
    """What the source says of the scheme: the rectangular system loses the lateral error."""
    short = {"references": "direct", "tau_s": 4.0, "turn_s": 1.0, "settle_s": 2.0}
    outcome = run((-1.0, -2.5, -30.0), MockOptions(ideal=True), **short)
    assert outcome.finished
    assert abs(outcome.error.x) > 0.2
    straight = run((0.0, -1.5, 0.0), MockOptions(ideal=True), **short)
    assert straight.position < 1e-3


def estimates():
    """Return the loop and the estimator after a straight drive, and its last estimate."""
    velocity, loop = Velocity(0.2, 0.0), Loop(START, MockOptions(ideal=True), LARGE)
    estimator = Tensor2d(Tensor2dOptions(), loop.context)
    estimate = estimator.update(loop.perception.update(loop.backend.camera.read()), STANDSTILL, 0.0)
    for tick in range(10):
        loop.backend.base.command(velocity)
        loop.backend.clock.sleep_until(0.1 * (tick + 1))
        views = loop.perception.update(loop.backend.camera.read())
        estimate = estimator.update(views, velocity, 0.1)
    return loop, estimator, estimate


def test_elements_scale_and_heading_are_those_of_the_poses():
    loop, estimator, estimate = estimates()
    start = np.array([START[0], START[1], math.radians(START[2])])
    truth = loop.backend.truth()
    metric = tensor_2d_from_poses(start, np.array([truth.x, truth.y, truth.phi]))
    expected, _ = normalised_2d(metric, np.eye(12))
    np.testing.assert_allclose(estimate.elements, expected, atol=1e-6)
    assert estimate.scale_m == pytest.approx(math.hypot(START[0], START[1]), rel=1e-3)
    assert estimate.heading == pytest.approx(truth.phi, abs=1e-5)
    np.testing.assert_allclose(estimate.target, expected[[T221, T223]], atol=1e-6)
    assert set(estimator.values()) == {signal.name for signal in estimator.signals}


def test_few_and_disagreeing_features_are_named():
    loop, estimator, good = estimates()
    views = loop.perception.update(loop.backend.camera.read())
    few = replace(views, ids=views.ids[:5], target=views.target[:5], initial=views.initial[:5])
    few = replace(few, current=views.current[:5], pixels=views.pixels[:5])
    lost = estimator.update(few, STANDSTILL, 0.1)
    assert lost.health is Health.LOST
    assert "5, 8 are needed" in lost.reason
    np.testing.assert_array_equal(lost.elements, good.elements)
    shuffled = replace(views, current=np.random.default_rng(0).permutation(views.current))
    wrong = estimator.update(shuffled, STANDSTILL, 0.1)
    assert wrong.health is Health.DEGENERATE
    assert "features disagree" in wrong.reason
    same = estimator.update(replace(views, initial=views.target), STANDSTILL, 0.1)
    assert "views identical" in same.reason


def test_lost_features_stop_the_robot():
    loop, _, good = estimates()
    law = Trifocal2d(Trifocal2dOptions(advance_m=0.0), loop.context)
    assert law.update(good, STANDSTILL, 0.0).velocity != STANDSTILL
    assert law.update(replace(good, health=Health.LOST), STANDSTILL, 0.1).velocity == STANDSTILL
