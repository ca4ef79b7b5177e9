"""The law against (3.7)–(3.12) written out in matrices, and the parts it is made of."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visctrl.contracts import Health
from visctrl.geometry.trifocal.tensor import (
    T111,
    T112,
    T121,
    T122,
    T211,
    T212,
    T221,
    T222,
    dynamics,
    normalised,
    tensor_from_poses,
)
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.robots.unicycle import step_exact
from visctrl.schemes.sliding_mode import CosineDescent, switching
from visctrl.schemes.termination import Arrival, ArrivalOptions, Divergence, Verdict
from visctrl.schemes.trifocal.estimate import TensorEstimate
from visctrl.schemes.trifocal.law import Outputs, TrifocalState, decoupled, without_spinning
from visctrl.schemes.trifocal.law_smc import PUBLISHED, TrifocalSmcOptions

poses = st.tuples(st.floats(-3.0, 3.0), st.floats(-15.0, -1.0), st.floats(-0.6, 0.6)).map(np.array)


def estimate_at(initial, current, phi_1=None):
    metric = tensor_from_poses(initial, current)
    return TensorEstimate(
        health=Health.OK,
        elements=normalised(metric),
        covariance=np.zeros((8, 8)),
        phi_1=float(initial[2]) if phi_1 is None else phi_1,
        phi_1_sd=0.0,
        scale_m=float(metric[T121]),
        scale_sd_m=0.0,
    )


@given(poses, st.floats(0.3, 0.9), st.floats(-0.2, 0.2), st.floats(-0.1, 0.1))
@settings(max_examples=50)
def test_inverse_is_that_of_the_decoupling_matrix(initial, share, rate_1, rate_2):
    estimate = estimate_at(initial, share * initial)
    T, s, c = estimate.elements, math.sin(initial[2]), math.cos(initial[2])
    M = np.array(
        [
            [-c / estimate.scale_m, T[T122] - T[T111]],
            [s / estimate.scale_m, T[T222] - T[T211]],
        ]
    )
    expected = np.linalg.solve(M, [rate_1, rate_2])
    velocity = decoupled(TrifocalState.of(estimate, 0.0), Outputs(rate_1, rate_2), 0.0)
    np.testing.assert_allclose(velocity, expected, rtol=1e-6, atol=1e-9)
    assert estimate.determinant == pytest.approx(np.linalg.det(M) * estimate.scale_m, abs=1e-9)


@given(poses, st.floats(0.3, 0.9))
@settings(max_examples=30)
def test_wanted_rates_come_out_of_the_dynamics(initial, share):
    """Driving (3.5) with M⁻¹ u gives the outputs the rates u."""
    estimate = estimate_at(initial, share * initial)
    v, omega = decoupled(TrifocalState.of(estimate, 0.0), Outputs(-0.03, 0.01), 0.0)
    rates = dynamics(estimate.elements, initial[2], estimate.scale_m, v, omega)
    assert rates[T112] + rates[T121] == pytest.approx(-0.03, abs=1e-9)
    assert rates[T212] + rates[T221] == pytest.approx(0.01, abs=1e-9)


def source_run(start, phi_1_known=True):
    """The source's law written out, on exact tensors at 10 Hz: its own statement of the error."""
    initial = np.array([start[0], start[1], math.radians(start[2])])
    phi_1 = initial[2] if phi_1_known else 0.0
    s, c = math.sin(phi_1), math.cos(phi_1)
    pose, first = initial.copy(), None
    for tick in range(1200):
        t = tick * 0.1
        metric = tensor_from_poses(initial, pose)
        T, scale = normalised(metric), metric[T121]
        xi = np.array([T[T112] + T[T121], T[T212] + T[T221]])
        first = xi if first is None else first
        level, slope = CosineDescent(100.0).at(t)
        error = xi - first * level
        if t > 100.0:
            v, omega = 0.1 * np.sign(error[0]), 0.3 * T[T122] / T[T112]
        elif abs((T[T111] - T[T122]) * s + (T[T211] - T[T222]) * c) < 0.04:
            v = 0.1 * np.sign(error[0])
            omega = -0.05 * np.sign(error[1] * (T[T222] - T[T211]))
        else:
            u = first * slope - 0.02 * np.sign(error) - [1.0, 2.0] * error
            M = [[-c / scale, T[T122] - T[T111]], [s / scale, T[T222] - T[T211]]]
            v, omega = np.linalg.solve(M, u)
        pose = step_exact(pose, v, omega, 0.1)
    return pose[0] * 100, pose[1] * 100, math.degrees(pose[2])


@pytest.mark.parametrize(
    ("start", "x_cm", "phi_deg"),
    [
        ((5.0, -5.0, 45.0), -0.28, 0.10),
        ((-5.0, -12.0, -30.0), 0.85, 0.02),
        ((0.0, -8.0, 0.0), 0.0, 0.0),
        ((1.0, -14.0, -6.0), 0.91, 0.08),
    ],
)
def test_the_source_s_table_comes_out_of_its_law(start, x_cm, phi_deg):
    """x and φ as published; y lies in the ±1 cm between which v = ±0.1 m/s chatters at 10 Hz."""
    x, y, phi = source_run(start)
    assert x == pytest.approx(x_cm, abs=0.25)
    assert abs(y) < 1.1
    assert phi == pytest.approx(phi_deg, abs=0.03)


def test_published_gains_are_the_source_s():
    assert TrifocalSmcOptions(law="published").gains() == PUBLISHED
    assert PUBLISHED.boundary_layer == PUBLISHED.damping == 0.0
    assert TrifocalSmcOptions(law="published", threshold=0.02).gains().threshold == 0.02


def test_switching_is_discontinuous_or_a_ramp():
    assert [switching(s, 0.0) for s in (-1e-12, 0.0, 2.0)] == [-1.0, 0.0, 1.0]
    assert [switching(s, 0.5) for s in (-9.0, -0.25, 0.25, 9.0)] == [-1.0, -0.5, 0.5, 1.0]


@given(st.floats(1.0, 100.0), st.floats(0.0, 0.2))
@settings(max_examples=50)
def test_descent_joins_a_motion_and_ends_at_rest(duration, slope):
    descent = CosineDescent.joining(duration, slope)
    assert descent.at(0.0)[0] == pytest.approx(1.0)
    if slope * duration < 1.5:
        assert descent.at(0.0)[1] == pytest.approx(-slope, abs=1e-6)
    assert descent.at(duration) == (0.0, 0.0)
    step = 1e-4 * duration
    for t in np.linspace(0.1, 0.9, 5) * duration:
        ahead, behind = descent.at(t + step)[0], descent.at(t - step)[0]
        assert descent.at(t)[1] == pytest.approx((ahead - behind) / (2 * step), abs=1e-5)
        assert behind >= ahead


def test_turning_faster_than_driving_is_bounded():
    assert without_spinning(Velocity(0.0, 1.0)).omega < 0.1
    assert without_spinning(Velocity(0.4, 0.5)) == Velocity(0.4, 0.5)
    assert without_spinning(Velocity(-0.1, -5.0)).omega > -0.5


def judge_all(arrival, right, forward, heading, sent=STANDSTILL, ticks=60):
    verdicts = [arrival.judge((right, forward), heading, sent, 0.1) for _ in range(ticks)]
    return set(verdicts), verdicts[-1]


def test_arrival_by_position_and_heading():
    assert judge_all(Arrival(ArrivalOptions()), 0.002, 0.0, 0.0)[1] is Verdict.THERE
    under_way = {Verdict.UNDER_WAY}
    assert judge_all(Arrival(ArrivalOptions()), 0.0, 0.02, 0.0)[0] == under_way
    assert judge_all(Arrival(ArrivalOptions()), 0.0, 0.0, 0.02)[0] == under_way
    moving = Velocity(0.1, 0.0)
    assert judge_all(Arrival(ArrivalOptions()), 0.0, 0.0, 0.0, moving)[0] == under_way


def test_beside_the_target_it_asks_for_room():
    arrival = Arrival(ArrivalOptions())
    assert judge_all(arrival, 0.1, 0.0, 0.0, ticks=8)[1] is Verdict.BESIDE
    assert arrival.has_room(0.601)
    assert not arrival.has_room(0.599)


def test_it_asks_for_no_more_retreats_than_allowed():
    arrival = Arrival(ArrivalOptions(retreats=1))
    verdicts = [arrival.judge((0.1, 0.0), 0.0, STANDSTILL, 0.1) for _ in range(60)]
    assert verdicts.count(Verdict.BESIDE) == 1
    assert Verdict.THERE not in verdicts


def test_a_robot_much_farther_away_than_it_began_is_astray():
    divergence = Divergence(1.5, 0.5)
    assert not divergence.astray(1e9), "there is no first distance yet"
    divergence.begin(2.0)
    assert not divergence.astray(3.4)
    assert divergence.astray(3.6)
    assert not divergence.astray(3.6, unit_m=0.5), "the leeway is in metres"


def test_within_tolerance_it_waits_for_the_rest_but_not_for_ever():
    arrival = Arrival(ArrivalOptions())
    verdicts = [arrival.judge((0.0, 0.008), 0.0, STANDSTILL, 0.1) for _ in range(60)]
    assert 30 <= verdicts.index(Verdict.THERE) <= 45
