"""The smooth law: arrives aligned, without φ1 too, and calmly under what spoils real runs."""

import math
from dataclasses import replace

import numpy as np
import pytest
from closed_loop import LARGE, REAL, Loop

from visctrl.contracts import Health
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.mock.backend import MockOptions
from visctrl.hal.types import STANDSTILL
from visctrl.schemes.trifocal.estimator import Tensor
from visctrl.schemes.trifocal.law_smc import TrifocalSmc, TrifocalSmcOptions
from visctrl.schemes.trifocal.law_smooth import TrifocalSmooth, TrifocalSmoothOptions
from visctrl.schemes.trifocal.tensor_method import TensorOptions

IDEAL = MockOptions(ideal=True)
START = (-0.55, -1.35, -35.0)


def drive(loop, tensor=None, duration=60.0, **options):
    return loop._run(
        Tensor(tensor or TensorOptions(), loop.context),
        TrifocalSmooth(TrifocalSmoothOptions(**options), loop.context),
        duration,
    )


@pytest.mark.parametrize("phi_1", ["estimated", "zero", "given"])
@pytest.mark.parametrize("start", [(5.0, -5.0, 45.0), (1.0, -14.0, -6.0)])
def test_published_starts(start, phi_1):
    tensor = TensorOptions(phi_1=phi_1, phi_1_deg=start[2] if phi_1 == "given" else 0.0)
    outcome = drive(Loop(start, IDEAL, LARGE), tensor)
    assert outcome.finished
    assert outcome.position < 2e-3
    assert outcome.heading_deg < 0.05


@pytest.mark.parametrize("told_deg", [-30.0, 30.0])
def test_a_wrong_heading_of_the_start_does_no_harm(told_deg):
    """φ1 may be fixed anywhere between −30 and 30 deg (p. 60): it is an assumption then."""
    told = TensorOptions(phi_1="given", phi_1_deg=told_deg)
    outcome = drive(Loop((5.0, -5.0, 45.0), IDEAL, LARGE), told)
    assert outcome.finished
    assert outcome.position < 2e-3
    assert outcome.heading_deg < 0.05


def test_it_arrives_with_the_target_s_heading():
    """In the last 5 cm the heading is already the target's: nothing is left to turn."""
    outcome = drive(Loop(START, IDEAL, LARGE))
    near = [pose for pose in outcome.path if math.hypot(pose.x, pose.y) < 0.05]
    assert max(abs(math.degrees(pose.phi)) for pose in near) < 5.0


def test_without_turning_first_it_starts_beside_the_target():
    """The target lies 50 deg off the heading: no approach stage, the law turns as it drives."""
    loop = Loop((-1.0, -1.5, 15.0), MockOptions(noise_px=0.3, actuation=REAL))
    outcome = drive(loop)
    assert outcome.finished
    assert outcome.position < 0.01
    assert outcome.heading_deg < 0.3


def variation(outcome):
    omega = np.array([sent.omega for sent in outcome.sent])
    return np.abs(np.diff(omega[3 * len(omega) // 4 :])).sum()


def test_less_chatter_and_time_than_the_sliding_mode_law_on_a_late_robot():
    """0.3 s of delay: both arrive, this one in less time and with calmer turning at the end."""
    mock = MockOptions.model_validate(
        {"noise_px": 0.3, "near_m": 1.5, "far_m": 5.0, "actuation": {"delay_s": 0.3}}
    )
    sliding_loop, loop = Loop(START, mock), Loop(START, mock)
    turned = sliding_loop.face().duration
    sliding = sliding_loop._run(
        Tensor(TensorOptions(), sliding_loop.context),
        TrifocalSmc(TrifocalSmcOptions(), sliding_loop.context),
        60.0,
    )
    smooth = drive(loop)
    assert smooth.finished
    assert smooth.position < 0.01
    assert smooth.duration < sliding.duration + turned
    assert variation(smooth) < 0.7 * variation(sliding)


def test_a_projection_centre_five_pixels_off():
    """Where the robot's turning is seen as lateral motion, it must not feed on itself."""
    camera = load_camera("hypercatadioptric")
    true = camera.altered(cx=camera.cx + 5.0, cy=camera.cy - 5.0)
    mock = MockOptions(noise_px=0.3, near_m=1.5, far_m=5.0, actuation=REAL)
    loop = Loop((-0.5, -3.4, -8.0), mock, camera, true_camera=true, seed=1)
    outcome = drive(loop)
    assert outcome.finished
    assert outcome.position < 0.015
    assert outcome.heading_deg < 0.3


def test_a_camera_ahead_of_the_axle_and_one_that_sees_little():
    mock = MockOptions(noise_px=0.1, actuation=REAL)
    ahead = drive(Loop((-0.4, -1.6, -14.0), mock, mount="front"))
    narrow = drive(Loop((-0.3, -1.8, -9.0), mock, load_camera("perspective")))
    for outcome in (ahead, narrow):
        assert outcome.finished
        assert outcome.position < 0.01
        assert outcome.heading_deg < 0.3


def test_lost_and_missing_tensors_stop_the_robot():
    loop = Loop(START, IDEAL, LARGE)
    estimator = Tensor(TensorOptions(), loop.context)
    good = estimator.update(loop.perception.update(loop.backend.camera.read()), STANDSTILL, 0.0)
    law = TrifocalSmooth(TrifocalSmoothOptions(), loop.context)
    assert law.update(good, STANDSTILL, 0.0).velocity != STANDSTILL
    assert law.update(replace(good, health=Health.LOST), STANDSTILL, 0.1).velocity == STANDSTILL
    nothing, travelled = replace(good, health=Health.DEGENERATE), 0.0
    velocity = STANDSTILL
    law = TrifocalSmooth(TrifocalSmoothOptions(), loop.context)
    for _ in range(80):
        velocity = law.update(nothing, velocity, 0.1).velocity
        travelled += 0.1 * velocity.v
    assert velocity == STANDSTILL
    assert 0.2 < travelled < 0.6


def test_a_scale_that_never_comes_does_not_carry_it_past_the_target():
    """The refined method scales poorly on a short leg: the robot still slows down and stops."""
    mock = MockOptions(noise_px=0.3, near_m=1.5, far_m=5.0)
    outcome = drive(Loop(START, mock), TensorOptions(method="refined"))
    assert max(pose.y for pose in outcome.path) < 0.1
    assert outcome.position < 0.05
