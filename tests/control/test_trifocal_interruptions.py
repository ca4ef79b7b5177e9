"""The closed loop through a blackout, an obstacle that passes, and starts at the edge."""

import math
from dataclasses import replace

import numpy as np
import pytest
from closed_loop import LARGE, REAL, Loop

from visctrl.hal.faults import Faults
from visctrl.hal.mock.backend import MockOptions
from visctrl.schemes.trifocal.estimator import Tensor
from visctrl.schemes.trifocal.law_smc import TrifocalSmc, TrifocalSmcOptions
from visctrl.schemes.trifocal.law_smooth import TrifocalSmooth, TrifocalSmoothOptions
from visctrl.schemes.trifocal.tensor_method import TensorOptions

START = (-0.55, -1.6, -19.0)
LAWS = {
    "smc": lambda context: TrifocalSmc(TrifocalSmcOptions(), context),
    "smooth": lambda context: TrifocalSmooth(TrifocalSmoothOptions(), context),
}


def mock(**faults):
    options = {"noise_px": 0.3, "near_m": 1.5, "far_m": 5.0, "actuation": REAL}
    return MockOptions(**options, faults=Faults(**faults))


def drive(loop, law, duration=60.0):
    return loop._run(Tensor(TensorOptions(), loop.context), LAWS[law](loop.context), duration)


@pytest.mark.parametrize("law", LAWS)
def test_a_blackout_of_a_second_is_survived(law):
    outcome = drive(Loop(START, mock(camera_black_s=(3.0, 4.0))), law)
    assert outcome.finished
    assert outcome.position < 0.01
    assert outcome.heading_deg < 0.3
    dark = [sent for tick, sent in enumerate(outcome.sent) if 3.05 < 0.1 * tick < 3.95]
    assert all(sent.v == 0.0 for sent in dark)


@pytest.mark.parametrize("law", LAWS)
def test_an_obstacle_that_passes_hides_half_the_view(law):
    """It goes round the robot in four seconds and hides what lies behind it."""
    loop = Loop(START, mock())
    see, tick = loop.perception.update, [0]

    def hidden(frame):
        views, angle = see(frame), 1.5 * (0.1 * tick[0] - 4.0)
        tick[0] += 1
        if not 0.0 < angle < 2.0 * math.pi:
            return views
        bearing = np.arctan2(views.current[:, 0], views.current[:, 1])
        free = np.cos(bearing - angle) < 0.0
        arrays = ("ids", "target", "initial", "current", "pixels")
        kept = {name: getattr(views, name)[free] for name in arrays}
        return replace(views, **kept, sigmas=None)

    loop.perception.update = hidden
    outcome = drive(loop, law)
    assert outcome.finished
    assert outcome.position < 0.01
    assert outcome.heading_deg < 0.3


def test_bearings_alone_from_far_away_with_the_default_leg():
    loop = Loop((-5.0, -12.0, -30.0), MockOptions(ideal=True, noise_px=0.5), LARGE)
    outcome = loop.drive(TensorOptions(elevations=False), duration=90.0)
    assert outcome.finished
    assert outcome.position < 0.01
    assert outcome.heading_deg < 0.2


def test_a_start_within_the_noise_of_the_target_is_not_left():
    loop = Loop((0.0, -0.01, 0.0), mock())
    outcome = drive(loop, "smooth")
    assert outcome.finished
    assert outcome.position < 0.012
