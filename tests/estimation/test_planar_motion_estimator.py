"""The target's bearing while the robot turns: followed, found again, and honest when lost."""

import math

import numpy as np
import pytest
from drives import PERIOD, SIGMA, Drive, context

from visctrl.contracts import Health
from visctrl.geometry.trifocal.tensor import target_in_view
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.robots.unicycle import wrap_angle
from visctrl.schemes.approach.estimator import PlanarMotionEstimator, PlanarMotionOptions

START = (0.8, -1.5, 1.2)
TURN = Velocity(0.0, -0.4)


def estimator():
    return PlanarMotionEstimator(PlanarMotionOptions(), context())


def bearing(drive):
    right, forward = target_in_view(drive.pose)
    return math.atan2(right, forward)


@pytest.mark.parametrize("outliers", [0, 15])
def test_bearing_is_followed_through_a_turn(outliers):
    drive, plugin = Drive(START, sigma=SIGMA), estimator()
    estimate = plugin.update(drive.views(outliers), STANDSTILL, 0.0)
    for _ in range(60):
        assert estimate.health is Health.OK
        error = float(wrap_angle(estimate.bearing - bearing(drive)))
        assert abs(error) < math.radians(1.0)
        assert abs(wrap_angle(estimate.motion.phi + drive.pose[2])) < math.radians(0.5)
        drive.step(TURN)
        estimate = plugin.update(drive.views(outliers), TURN, PERIOD)
    assert set(plugin.values()) == {signal.name for signal in plugin.signals}


def test_a_jump_is_found_again():
    drive, plugin = Drive(START, sigma=SIGMA), estimator()
    plugin.update(drive.views(), STANDSTILL, 0.0)
    drive.pose[2] -= 1.5
    estimate = plugin.update(drive.views(15), STANDSTILL, PERIOD)
    assert abs(float(wrap_angle(estimate.bearing - bearing(drive)))) < math.radians(1.0)


def test_lost_and_back():
    drive, plugin = Drive(START, sigma=SIGMA), estimator()
    plugin.update(drive.views(), STANDSTILL, 0.0)
    lost = plugin.update(drive.nothing(), TURN, PERIOD)
    assert lost.health is Health.LOST
    assert lost.reason == "dark"
    assert plugin.values() == {}
    assert plugin.update(drive.views(), TURN, PERIOD).health is Health.OK


def test_at_the_target_there_is_no_bearing():
    drive = Drive((0.0, 0.0, 0.5), sigma=SIGMA)
    estimate = estimator().update(drive.views(), STANDSTILL, 0.0)
    assert estimate.health is Health.DEGENERATE
    assert estimate.motion.phi == pytest.approx(-0.5, abs=math.radians(0.3))
    assert np.isfinite(estimate.motion.phi_sd)


def test_reset_searches_anew():
    drive, plugin = Drive(START, sigma=SIGMA), estimator()
    first = plugin.update(drive.views(), STANDSTILL, 0.0)
    plugin.reset()
    assert plugin.values() == {}
    again = plugin.update(drive.views(), STANDSTILL, 0.0)
    assert again.bearing == pytest.approx(first.bearing, abs=math.radians(1.0))
