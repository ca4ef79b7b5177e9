"""Turning to the target: the shorter way, to the threshold, and no turn without a measurement."""

import math

import numpy as np
import pytest

from visctrl.contracts import Context, Health
from visctrl.geometry.two_view.planar import PlanarMotion
from visctrl.hal.actuation import Limiter
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.types import STANDSTILL
from visctrl.robots import load_robot
from visctrl.robots.documents import validate
from visctrl.robots.errors import InputError
from visctrl.schemes.approach.law import FaceTarget, FaceTargetOptions
from visctrl.schemes.trifocal.estimate import PlanarMotionEstimate

PERIOD = 0.1


def controller() -> FaceTarget:
    context = Context(
        camera=load_camera("hypercatadioptric"),
        limits=load_robot("p3dx").operating,
        camera_forward_m=0.0,
        period_s=PERIOD,
        seed=0,
        lockstep=True,
    )
    return FaceTarget(FaceTargetOptions(), context)


def seen(bearing: float, health: Health = Health.OK, sd: float = 0.01) -> PlanarMotionEstimate:
    covariance = np.diag([1e-4, sd**2])
    motion = PlanarMotion(0.0, bearing, covariance, np.ones(20, dtype=bool))
    return PlanarMotionEstimate(health=health, motion=motion)


def turn_until_finished(bearing: float) -> tuple[float, int]:
    face, sent = controller(), STANDSTILL
    limiter = Limiter(face.context.limits, whole_units=True)
    for tick in range(300):
        decision = face.update(seen(bearing), sent, PERIOD)
        assert decision.velocity.v == 0.0
        if decision.finished:
            return bearing, tick
        # A counter-clockwise turn moves a fixed target clockwise.
        sent = limiter.limit(decision.velocity, PERIOD)
        bearing += sent.omega * PERIOD
    raise AssertionError("the turn never ended")


@pytest.mark.parametrize("degrees", [-170.0, -60.0, -13.0, 13.0, 45.0, 175.0])
def test_it_turns_to_the_target(degrees: float) -> None:
    bearing, ticks = turn_until_finished(math.radians(degrees))
    assert ticks > 0
    assert abs(math.degrees(bearing)) <= FaceTargetOptions().end_deg


@pytest.mark.parametrize("degrees", [-100.0, 100.0])
def test_the_first_turn_goes_the_shorter_way(degrees: float) -> None:
    omega = controller().update(seen(math.radians(degrees)), STANDSTILL, 0.0).velocity.omega
    assert math.copysign(1.0, omega) == math.copysign(1.0, -degrees)


def test_a_robot_that_heads_there_does_not_turn() -> None:
    decision = controller().update(seen(math.radians(11.0)), STANDSTILL, 0.0)
    assert decision.finished
    assert decision.velocity == (0.0, 0.0)


def test_without_a_baseline_there_is_nothing_to_turn_to() -> None:
    decision = controller().update(seen(1.0, Health.DEGENERATE, math.inf), STANDSTILL, 0.0)
    assert decision.finished
    assert decision.velocity == (0.0, 0.0)


def test_it_stands_while_the_features_are_lost() -> None:
    face = controller()
    assert face.update(seen(1.0), STANDSTILL, 0.0).velocity.omega != 0.0
    decision = face.update(seen(1.0, Health.LOST, math.inf), STANDSTILL, PERIOD)
    assert decision.velocity == (0.0, 0.0)
    assert not decision.finished


def test_an_end_beyond_the_start_is_refused() -> None:
    with pytest.raises(InputError, match="end_deg"):
        validate({"start_deg": 2.0, "end_deg": 5.0}, FaceTargetOptions, "options")
