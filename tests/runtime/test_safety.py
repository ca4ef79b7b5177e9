from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from visctrl.contracts import Health
from visctrl.hal.actuation import Limiter
from visctrl.hal.errors import StaleFrameError
from visctrl.hal.types import STANDSTILL, Frame, Velocity
from visctrl.robots import Limits, load_robot
from visctrl.robots.errors import InputError
from visctrl.runtime.safety import (
    Guard,
    LostError,
    SafetyOptions,
    UnsafeCommandError,
    effective_limits,
)

LIMITS = Limits(v_m_s=0.4, omega_deg_s=50, acceleration_m_s2=0.3, angular_acceleration_deg_s2=100)
PERIOD = 0.1
speeds = st.floats(-5.0, 5.0)


def guard(limits: Limits | None = LIMITS, **options: float) -> Guard:
    limiter = Limiter(limits, whole_units=False)
    made = Guard(limiter, SafetyOptions(**options), PERIOD)
    made.begin(0.0)
    return made


def settled(limits: Limits, velocity: Velocity) -> Velocity:
    """Return what is permitted once the ramp has had time enough."""
    made = guard(limits)
    made.was_sent(STANDSTILL, -100.0)
    return made.permit(velocity, 0.0)


@given(speeds, speeds)
def test_speeds_are_bounded_and_the_curvature_is_kept(v: float, omega: float) -> None:
    permitted = settled(LIMITS, Velocity(v, omega))
    assert abs(permitted.v) <= LIMITS.v_m_s + 1e-12
    assert abs(permitted.omega) <= LIMITS.omega_rad_s + 1e-12
    assert permitted.v * omega == pytest.approx(permitted.omega * v, abs=1e-9)
    if abs(v) <= LIMITS.v_m_s and abs(omega) <= LIMITS.omega_rad_s:
        assert permitted == Velocity(v, omega)


@given(st.lists(st.tuples(speeds, speeds, st.floats(0.01, 0.5)), max_size=30))
def test_the_command_changes_no_faster_than_the_robot_may(
    steps: list[tuple[float, float, float]],
) -> None:
    made, now, before = guard(), 0.0, STANDSTILL
    for v, omega, dt in steps:
        now += dt
        permitted = made.permit(Velocity(v, omega), now)
        # The first command of a stage counts on one nominal period.
        passed = dt if before is not STANDSTILL else max(dt, PERIOD)
        assert abs(permitted.v - before.v) <= LIMITS.acceleration_m_s2 * passed + 1e-9
        turn = LIMITS.angular_acceleration_rad_s2 * passed
        assert abs(permitted.omega - before.omega) <= turn + 1e-9
        made.was_sent(permitted, now)
        before = permitted


def test_an_ideal_base_gets_what_was_wanted() -> None:
    assert guard(None).permit(Velocity(9.0, -9.0), 0.0) == Velocity(9.0, -9.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("limits", [LIMITS, None])
def test_a_velocity_that_is_not_finite_is_refused(bad: float, limits: Limits | None) -> None:
    for velocity in (Velocity(bad, 0.0), Velocity(0.0, bad)):
        with pytest.raises(UnsafeCommandError, match="not finite"):
            guard(limits).permit(velocity, 0.0)


def test_frame_age_old_frames_are_refused_and_a_frozen_camera_is_a_failure() -> None:
    made = guard(max_frame_age_s=0.5, frozen_timeout_s=2.0)
    frame = Frame(stamp=1.0, sequence=3)
    assert made.frame_problem(frame, 1.5) == ""
    assert "0.60 s old" in made.frame_problem(frame, 1.6)
    with pytest.raises(StaleFrameError, match="frozen"):
        made.frame_problem(frame, 3.1)


def test_lost_features_hold_the_robot_until_the_timeout() -> None:
    made = guard(lost_timeout_s=2.0)
    assert not made.must_hold(Health.OK, "", 1.0)
    assert made.must_hold(Health.LOST, "dark", 1.1)
    assert not made.must_hold(Health.DEGENERATE, "", 2.0), "degenerate is for the controller"
    assert made.must_hold(Health.LOST, "dark", 3.9)
    with pytest.raises(LostError, match="for 2 s: dark"):
        made.must_hold(Health.LOST, "dark", 4.1)


def test_a_moving_robot_needs_a_fresh_command() -> None:
    made = guard(max_command_age_s=0.5)
    assert not made.expired(10.0), "nothing has been sent"
    made.was_sent(STANDSTILL, 0.0)
    assert not made.expired(10.0), "a robot that stands may go on standing"
    made.was_sent(Velocity(0.1, 0.0), 10.0)
    assert not made.expired(10.4)
    assert made.expired(10.6)


def test_limits_may_be_set_up_to_what_the_hardware_can_do() -> None:
    robot = load_robot("p3dx")
    usual = effective_limits(robot, SafetyOptions(), "x")
    assert usual == robot.operating.model_copy(
        update={"wheel_m_s": robot.hardware.v_m_s, "track_m": robot.wheels.effective_track_m}
    )
    limits = effective_limits(robot, SafetyOptions(v_m_s=0.1), "x")
    assert limits.v_m_s == 0.1
    assert limits.omega_deg_s == robot.operating.omega_deg_s
    with pytest.raises(InputError, match=r"scenario\.yaml: key 'safety\.v_m_s': at most 1\.2"):
        effective_limits(robot, SafetyOptions(v_m_s=1.3), "scenario.yaml")
