"""The super-twisting law: finite-time surfaces, the published starts, late and slipping robots."""

import math
from dataclasses import replace

import numpy as np
import pytest
from closed_loop import LARGE, Loop
from hypothesis import given
from hypothesis import strategies as st

from visctrl.contracts import Health
from visctrl.hal.mock.backend import MockOptions
from visctrl.hal.types import STANDSTILL
from visctrl.schemes.super_twisting import SuperTwisting
from visctrl.schemes.trifocal.estimator import Tensor
from visctrl.schemes.trifocal.law_super_twisting import (
    SuperTwistingOptions,
    TrifocalSuperTwisting,
)
from visctrl.schemes.trifocal.tensor_method import TensorOptions

IDEAL = MockOptions(ideal=True)
START = (-0.55, -1.35, -35.0)
PERIOD = 0.1


def drive(loop, tensor=None, duration=90.0):
    return loop._run(
        Tensor(tensor or TensorOptions(), loop.context),
        TrifocalSuperTwisting(SuperTwistingOptions(), loop.context),
        duration,
    )


@given(
    start=st.floats(-1.0, 1.0),
    disturbance=st.floats(-0.04, 0.04),
    horizon=st.floats(0.1, 1.0),
    late=st.integers(0, 2),
)
def test_it_reaches_its_surface_and_learns_the_disturbance(start, disturbance, horizon, late):
    """Whatever constant is added to s', s ends at zero and w at minus that, also a little late."""
    horizon = max(horizon, 4.0 * PERIOD * late)
    law = SuperTwisting(0.35, 0.02, most=0.06, horizon=horizon)
    s, commands = start, [0.0] * late
    for _ in range(1200):
        commands.append(law.step(s, PERIOD))
        s += PERIOD * (commands.pop(0) + disturbance)
    assert abs(s) < 1e-3
    assert law.integral == pytest.approx(-disturbance, abs=2e-3)


def test_without_a_disturbance_s_never_overshoots_in_one_step():
    """The implicit step ends at s or before it, for every s: explicit Euler chatters here."""
    law = SuperTwisting(0.35, 0.0, most=0.0, horizon=PERIOD)
    for s in np.geomspace(1e-6, 1.0, 50):
        after = s + PERIOD * law.step(float(s), PERIOD)
        assert 0.0 <= after < s


@pytest.mark.parametrize("start", [(5.0, -5.0, 45.0), (-5.0, -12.0, -30.0), (1.0, -14.0, -6.0)])
def test_published_starts(start):
    outcome = drive(Loop(start, IDEAL, LARGE))
    assert outcome.finished
    assert outcome.position < 1e-3
    assert outcome.heading_deg < 0.01
    assert variation(outcome) < 0.05


def test_phi_1_is_read_off_the_tensor_where_it_is_not_told():
    outcome = drive(Loop((5.0, -5.0, 45.0), IDEAL, LARGE), TensorOptions(phi_1="zero"))
    assert outcome.finished
    assert outcome.position < 2e-3
    assert outcome.heading_deg < 0.05


@pytest.mark.parametrize(
    "actuation",
    [{"delay_s": 0.5}, {"delay_s": 0.1, "slip_v": 0.2, "slip_omega": 0.2}],
    ids=["half a second late", "a fifth less"],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_late_and_weak_robots_arrive(actuation, seed):
    mock = MockOptions.model_validate(
        {"noise_px": 0.3, "near_m": 1.5, "far_m": 5.0, "actuation": actuation}
    )
    loop = Loop(START, mock, seed=seed)
    loop.face()
    outcome = drive(loop)
    assert outcome.finished
    assert outcome.position < 0.01
    assert outcome.heading_deg < 0.5


def variation(outcome):
    omega = np.array([sent.omega for sent in outcome.sent])
    return np.abs(np.diff(omega[3 * len(omega) // 4 :])).sum()


def test_lost_and_missing_tensors_stop_the_robot():
    loop = Loop(START, IDEAL, LARGE)
    estimator = Tensor(TensorOptions(), loop.context)
    good = estimator.update(loop.perception.update(loop.backend.camera.read()), STANDSTILL, 0.0)
    law = TrifocalSuperTwisting(SuperTwistingOptions(), loop.context)
    assert law.update(good, STANDSTILL, 0.0).velocity != STANDSTILL
    assert law.update(replace(good, health=Health.LOST), STANDSTILL, 0.1).velocity == STANDSTILL
    nothing, travelled = replace(good, health=Health.DEGENERATE), 0.0
    law, velocity = TrifocalSuperTwisting(SuperTwistingOptions(), loop.context), STANDSTILL
    for _ in range(80):
        velocity = law.update(nothing, velocity, PERIOD).velocity
        travelled += PERIOD * velocity.v
    assert velocity == STANDSTILL
    assert 0.2 < travelled < 0.6


def test_passing_the_target_it_comes_back_the_shorter_way():
    """Just behind the target its polar coordinates count from the robot's back."""
    outcome = drive(Loop((0.0, 0.12, 0.0), IDEAL, LARGE), duration=40.0)
    assert all(math.hypot(pose.x, pose.y) < 0.5 for pose in outcome.path)
