"""Bounds, whole units, delay and ramp of a base."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visctrl.hal.actuation import Actuation, ActuationOptions, Limiter
from visctrl.hal.types import Velocity
from visctrl.robots import Limits

LIMITS = Limits(
    v_m_s=0.4, omega_deg_s=50.0, acceleration_m_s2=0.3, angular_acceleration_deg_s2=100.0
)
EXACT = ActuationOptions(quantise=False)
speeds = st.floats(-5.0, 5.0)


@given(v=speeds, omega=speeds)
def test_bounds_hold_and_keep_the_curvature(v: float, omega: float) -> None:
    sent = Actuation(LIMITS, EXACT).request(0.0, Velocity(v, omega))
    assert abs(sent.v) <= LIMITS.v_m_s * (1 + 1e-12)
    assert abs(sent.omega) <= LIMITS.omega_rad_s * (1 + 1e-12)
    assert sent.v * omega == pytest.approx(sent.omega * v, abs=1e-12)
    if abs(v) <= LIMITS.v_m_s and abs(omega) <= LIMITS.omega_rad_s:
        assert sent == (v, omega)


@given(v=speeds, omega=speeds, top=st.floats(0.01, 1.0), top_deg=st.floats(1.0, 90.0))
def test_sent_commands_are_whole_units_within_the_bounds(
    v: float, omega: float, top: float, top_deg: float
) -> None:
    limits = LIMITS.model_copy(update={"v_m_s": top, "omega_deg_s": top_deg})
    plain = Actuation(limits, EXACT).request(0.0, Velocity(v, omega))
    sent = Actuation(limits, ActuationOptions()).request(0.0, Velocity(v, omega))
    for value, exact, bound in (
        (sent.v * 1000, plain.v * 1000, top * 1000),
        (math.degrees(sent.omega), math.degrees(plain.omega), top_deg),
    ):
        assert value == pytest.approx(round(value), abs=1e-9)
        assert abs(value) <= bound + 1e-9
        # Half a unit, or up to a whole one where rounding up would break the bound.
        assert abs(value - exact) <= (0.5 if abs(exact) + 0.5 <= bound else 1.0) + 1e-9


def test_an_ideal_base_executes_at_once_and_without_bounds() -> None:
    actuation = Actuation(None, EXACT)
    wild = Velocity(7.123456, -9.0)
    assert actuation.request(0.0, wild) == wild
    assert actuation.velocity_at(0.0, 1e-3) == wild


def test_ramp_takes_the_time_that_the_accelerations_give() -> None:
    actuation = Actuation(LIMITS, EXACT)
    actuation.request(0.0, Velocity(0.3, math.radians(30.0)))
    dt = 1 / 240
    reached_v = reached_w = None
    for k in range(400):
        now = actuation.velocity_at(k * dt, dt)
        if reached_v is None and now.v == 0.3:
            reached_v = (k + 1) * dt
        if reached_w is None and now.omega == math.radians(30.0):
            reached_w = (k + 1) * dt
    assert reached_v == pytest.approx(1.0, abs=1.5 * dt)
    assert reached_w == pytest.approx(0.3, abs=1.5 * dt)


@given(steps=st.lists(st.tuples(speeds, speeds, st.floats(0.001, 0.2)), max_size=30))
def test_ramp_never_exceeds_its_accelerations(steps: list[tuple[float, float, float]]) -> None:
    actuation = Actuation(LIMITS, ActuationOptions())
    t, before = 0.0, Velocity(0.0, 0.0)
    for v, omega, dt in steps:
        actuation.request(t, Velocity(v, omega))
        now = actuation.velocity_at(t, dt)
        assert abs(now.v - before.v) <= LIMITS.acceleration_m_s2 * dt + 1e-12
        assert abs(now.omega - before.omega) <= LIMITS.angular_acceleration_rad_s2 * dt + 1e-12
        t, before = t + dt, now


def test_delayed_commands_act_in_order_and_not_early() -> None:
    actuation = Actuation(None, ActuationOptions(quantise=False, delay_s=0.1))
    actuation.request(0.0, Velocity(1.0, 0.0))
    actuation.request(0.05, Velocity(2.0, 0.0))
    seen = [actuation.velocity_at(k * 0.01, 0.01).v for k in range(20)]
    assert seen == [0.0] * 10 + [1.0] * 5 + [2.0] * 5


def test_halt_forgets_pending_commands() -> None:
    actuation = Actuation(None, ActuationOptions(delay_s=0.1))
    actuation.request(0.0, Velocity(0.3, 0.0))
    actuation.halt()
    assert actuation.velocity_at(1.0, 0.1) == Velocity(0.0, 0.0)


@pytest.mark.parametrize("bad", [Velocity(math.nan, 0.0), Velocity(0.0, math.inf)])
def test_a_command_that_is_not_a_number_is_refused(bad: Velocity) -> None:
    with pytest.raises(ValueError, match="not finite"):
        Actuation(LIMITS, ActuationOptions()).request(0.0, bad)


def test_slip_leaves_its_share() -> None:
    options = ActuationOptions(slip_v=0.1, slip_omega=-0.2)
    assert options.executed(Velocity(1.0, 1.0), 0.4) == pytest.approx((0.9, 1.2))


def driven(limiter: Limiter, wanted: Velocity, ticks: int) -> list[Velocity]:
    sent = []
    for _ in range(ticks):
        sent.append(limiter.limit(wanted, 0.1))
        limiter.was_sent(sent[-1])
    return sent


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
@settings(max_examples=100)
def test_rounding_keeps_the_mean(v: float, omega: float) -> None:
    """However small against 1 mm/s and 1 deg/s, what was wanted is executed on average."""
    limiter = Limiter(LIMITS, whole_units=True)
    wanted = Velocity(v * 0.01, omega * 0.06)
    driven(limiter, wanted, 20)
    sent = driven(limiter, wanted, 200)
    assert np.mean([s.v for s in sent]) == pytest.approx(wanted.v, abs=1e-5)
    assert np.mean([s.omega for s in sent]) == pytest.approx(wanted.omega, abs=2e-4)


@given(st.lists(st.tuples(st.floats(-3.0, 3.0), st.floats(-5.0, 5.0)), min_size=1), st.booleans())
def test_bounds_of_speed_and_acceleration_hold(
    wishes: list[tuple[float, float]], whole: bool
) -> None:
    limiter, before = Limiter(LIMITS, whole_units=whole), Velocity(0.0, 0.0)
    unit = Velocity(1e-3, math.radians(1.0)) if whole else Velocity(0.0, 0.0)
    for wish in wishes:
        sent = limiter.limit(Velocity(*wish), 0.1)
        limiter.was_sent(sent)
        assert LIMITS.ratio(*sent) <= 1.0 + 1e-9
        assert abs(sent.v - before.v) <= 0.1 * LIMITS.acceleration_m_s2 + unit.v + 1e-9
        turn = 0.1 * LIMITS.angular_acceleration_rad_s2
        assert abs(sent.omega - before.omega) <= turn + unit.omega + 1e-9
        before = sent


def test_bounds_keep_the_curvature() -> None:
    sent = driven(Limiter(LIMITS, whole_units=False), Velocity(1.0, 0.5), 100)[-1]
    assert sent.omega / sent.v == pytest.approx(0.5)
    assert LIMITS.ratio(*sent) == pytest.approx(1.0)


def test_an_ideal_base_gets_what_was_wanted() -> None:
    wild = Velocity(9.123456, 9.0)
    assert Limiter(None, whole_units=False).limit(wild, 0.1) == wild


def test_a_robot_that_was_stopped_ramps_from_standstill_and_owes_nothing() -> None:
    limiter = Limiter(LIMITS, whole_units=True)
    driven(limiter, Velocity(0.2003, 0.011), 50)
    limiter.was_sent(Velocity(0.0, 0.0))
    fresh = Limiter(LIMITS, whole_units=True)
    wanted = Velocity(0.3, 0.2)
    assert driven(limiter, wanted, 20) == driven(fresh, wanted, 20)
