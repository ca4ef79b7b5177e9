"""The sliding-mode law: on exact epipoles, its singularity, its gain conditions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from epipolar_world import PERSPECTIVE, TS, context
from hypothesis import given, settings
from hypothesis import strategies as st

from visctrl.contracts import Decision, Health
from visctrl.hal.types import STANDSTILL
from visctrl.robots.unicycle import step_exact
from visctrl.schemes.epipolar.estimate import EpipoleEstimate, EpipolePair
from visctrl.schemes.epipolar.gains import bounded_margins, decoupling_margins, depth_margin
from visctrl.schemes.epipolar.law_smc import EpipolarSmc, EpipolarSmcOptions

TARGET = np.zeros(3)


def bearing(of: np.ndarray, seen_from: np.ndarray) -> float:
    dx, dy = of[:2] - seen_from[:2]
    phi = seen_from[2]
    right, forward = (
        dx * math.cos(phi) + dy * math.sin(phi),
        dy * math.cos(phi) - dx * math.sin(phi),
    )
    return math.atan2(right, forward)


def exact_pair(a: np.ndarray, b: np.ndarray) -> EpipolePair:
    return EpipolePair(bearing(b, a), bearing(a, b), 0.0, 0.0, float(b[2] - a[2]), 0.0)


def drive_on_exact_epipoles(start: tuple[float, float, float], **options: float | bool):
    """The law on exact epipoles and exact arcs: errors (cm, cm, deg) and inputs."""
    x, y, degrees = start
    pose = np.array([x, y, math.radians(degrees)])
    first, aligned = pose.copy(), None
    law = EpipolarSmc(EpipolarSmcOptions(**options), context(PERSPECTIVE))
    inputs, velocity = [], STANDSTILL
    for k in range(200):
        t = k * TS
        if aligned is None and t >= 16.0:
            aligned = pose.copy()
        estimate = EpipoleEstimate(
            Health.OK,
            "",
            exact_pair(pose, TARGET),
            exact_pair(first, pose),
            exact_pair(first, TARGET),
            None if aligned is None else exact_pair(aligned, pose),
        )
        velocity = law.update(estimate, velocity, TS if k else 0.0).velocity
        inputs.append(velocity)
        pose = step_exact(pose, velocity.v, velocity.omega, TS)
    return np.array([100 * pose[0], 100 * pose[1], math.degrees(pose[2])]), np.array(inputs)


#: What an independent copy of the law gives on exact epipoles (cm, cm, deg).
@pytest.mark.parametrize(
    ("start", "expected"),
    [
        ((4, -8, 40), (0.0, -0.07, 0.71)),
        ((3, -11, 15.26), (-0.06, 2.35, 1.52)),
        ((-5, -13, 0), (0.08, 4.87, -1.12)),
        ((-7, -18, -10), (0.27, 10.9, -1.61)),
    ],
)
def test_matches_an_independent_copy(start, expected) -> None:
    error, inputs = drive_on_exact_epipoles(start)
    assert error == pytest.approx(expected, abs=0.12)
    assert np.abs(inputs).max(axis=0) == pytest.approx([2.3, 0.7], abs=2.1)


def test_without_the_sliding_mode_the_inputs_explode_at_the_singularity() -> None:
    error, unprotected = drive_on_exact_epipoles((-5, -13, 0), sliding=False)
    _, protected = drive_on_exact_epipoles((-5, -13, 0))
    assert np.isfinite(unprotected).all()
    assert np.abs(unprotected[:, 0]).max() > 100 * np.abs(protected[:, 0]).max()
    assert abs(error[1]) > 100.0


def test_a_start_on_the_singularity_leaves_it_with_bounded_inputs() -> None:
    start = (3.0, -11.0, math.degrees(math.atan2(3, 11)))
    error, inputs = drive_on_exact_epipoles(start)
    assert np.abs(inputs[:, 0]).max() < 3.0
    assert abs(error[0]) < 1.0


def test_the_run_ends_when_the_depth_is_right() -> None:
    options = EpipolarSmcOptions(duration_s=20, finish_error=1e-3, finish_ticks=3)
    law = EpipolarSmc(options, context(PERSPECTIVE))
    start, here = np.array([2.0, -8.0, 0.3]), np.array([0.0, 0.0, 0.0])
    near = np.array([0.0, -0.004, 0.0])

    def estimate(pose: np.ndarray) -> EpipoleEstimate:
        pairs = exact_pair(pose, here), exact_pair(start, pose), exact_pair(start, here)
        return EpipoleEstimate(Health.OK, "", *pairs)

    law.update(estimate(start), STANDSTILL, 0.0)
    decisions = [law.update(estimate(near), STANDSTILL, dt) for dt in (17.0, 0.1, 0.1)]
    assert [d.finished for d in decisions] == [False, False, True]


def test_holds_still_without_epipoles() -> None:
    law = EpipolarSmc(EpipolarSmcOptions(), context(PERSPECTIVE))
    lost = EpipolePair(0, 0, math.inf, math.inf, 0, math.inf, Health.LOST, "too few features")
    short = EpipolePair(0.1, 0.2, 1.0, 1.0, 0, 0.0, Health.DEGENERATE, "short baseline")
    for estimate in (
        EpipoleEstimate(Health.LOST, "no features"),
        EpipoleEstimate(Health.LOST, "", lost, lost, lost),
        EpipoleEstimate(Health.DEGENERATE, "", short, short, short),
    ):
        decision = law.update(estimate, STANDSTILL, 0.0)
        assert decision == Decision(decision.velocity, "hold")
        assert decision.velocity == (0.0, 0.0)


angles = st.floats(-1.2, 1.2).filter(lambda q: abs(q) > 0.05)


@given(
    angles,
    st.floats(-1.0, 1.0),
    st.floats(2.0, 20.0),
    st.floats(0.3, 3.0),
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
    st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)),
)
@settings(max_examples=300, deadline=None)
def test_a_positive_margin_means_that_the_surface_attracts(
    q: float,
    psi: float,
    distance: float,
    focal: float,
    surfaces: tuple[float, float],
    rates: tuple[float, float],
) -> None:
    """(2.22) against the motion of the epipoles itself, by differences of (2.2)."""
    kappas, lambdas, assumed = (2 / 600, 2 / 600), (2.0, 1.0), 10.0
    margins = decoupling_margins(
        surfaces,
        rates,
        (q, psi),
        kappas,
        lambdas,
        distance_ratio=assumed / distance,
        focal_ratio=focal,
    )
    u_c, u_t = (
        rate - kappa * np.sign(s) - gain * s
        for rate, kappa, gain, s in zip(rates, kappas, lambdas, surfaces, strict=True)
    )
    # The law believes the angles of the epipoles it sees; with another focal length those are
    # scaled, which (2.22) treats as a factor on the epipoles' own motion.
    v = assumed * math.cos(psi) ** 2 * u_t / math.sin(q)
    omega = math.cos(q) ** 2 * u_c - math.cos(psi) ** 2 * u_t
    pose = np.array([distance * math.sin(psi), -distance * math.cos(psi), q + psi])
    step = 1e-6
    after, before = (step_exact(pose, v, omega, dt) for dt in (step, -step))

    def epipoles(p: np.ndarray) -> np.ndarray:
        return focal * np.array([math.tan(bearing(TARGET, p)), math.tan(bearing(p, TARGET))])

    motion = (epipoles(after) - epipoles(before)) / (2 * step) - rates
    for s, rate, margin in zip(surfaces, motion, margins, strict=True):
        if margin > 1e-6 and abs(s) > 1e-6:
            assert s * rate < 0.0


@given(angles, st.floats(-1.0, 1.0), st.floats(2.0, 20.0), st.tuples(angles, angles))
@settings(max_examples=200, deadline=None)
def test_bounded_margins_mean_attraction(
    q: float, psi: float, distance: float, surfaces: tuple[float, float]
) -> None:
    rates, gains = (0.01, -0.005), (0.1, 0.06)
    margins = bounded_margins(rates, (q, psi), gains, distance=distance)
    v = gains[0] * np.sign(-surfaces[1] * math.sin(q))
    omega = -gains[1] * np.sign(surfaces[0])
    rate_c = (math.sin(q) / distance * v + omega) / math.cos(q) ** 2 - rates[0]
    rate_t = math.sin(q) / (distance * math.cos(psi) ** 2) * v - rates[1]
    if margins.omega > 1e-9:
        assert surfaces[0] * rate_c < 0.0
    if margins.v > 1e-9:
        assert surfaces[1] * rate_t < 0.0


def test_exact_parameters_need_any_positive_gain_and_the_singularity_has_none() -> None:
    margins = decoupling_margins(
        (0.1, 0.1), (0.3, 0.3), (0.2, 0.3), (0.01, 0.01), (0, 0), distance_ratio=1.0
    )
    assert (float(margins.current), float(margins.target)) == pytest.approx((0.01, 0.01))
    assert float(depth_margin(0.5, 1.0, 0.02, distance_ratio=1.0)) == pytest.approx(0.02)
    assert float(depth_margin(0.5, 1.0, 0.02, distance_ratio=2.0)) == pytest.approx(0.02 - 0.25)
    on_it = bounded_margins((0.0, 0.1), (0.0, 0.1), (0.1, 0.06), distance=5.0)
    assert float(on_it.v) == -math.inf
