"""Closed loops: published starts, short tasks with a real base's limits, faults on the way."""

import math
from dataclasses import replace

import numpy as np
import pytest
from closed_loop import LARGE, REAL, Loop

from visctrl.contracts import Context, Health
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.mock.backend import MockOptions
from visctrl.hal.types import STANDSTILL
from visctrl.robots import load_robot
from visctrl.schemes.trifocal.estimator import Tensor
from visctrl.schemes.trifocal.law_smc import TrifocalSmc, TrifocalSmcOptions
from visctrl.schemes.trifocal.tensor_method import TensorOptions

TABLE_3_1 = [(5.0, -5.0, 45.0), (-5.0, -12.0, -30.0), (0.0, -8.0, 0.0), (1.0, -14.0, -6.0)]
TAU_100 = TrifocalSmcOptions(tau_s=100.0)
IDEAL = MockOptions(ideal=True)


def short_starts(count, seed=0):
    rng = np.random.default_rng(seed)
    return [
        (rng.uniform(-1.2, 1.2), rng.uniform(-3.5, -1.2), rng.uniform(-35.0, 35.0))
        for _ in range(count)
    ]


@pytest.mark.parametrize("start", TABLE_3_1)
def test_published_starts_without_noise(start):
    outcome = Loop(start, IDEAL, LARGE).drive(law=TAU_100, duration=120.0)
    assert outcome.finished
    assert outcome.position < 1e-3
    assert outcome.heading_deg < 0.05


@pytest.mark.parametrize("start", TABLE_3_1[:2])
def test_published_starts_with_phi_1_set_to_zero(start):
    """The law is told that φ1 = 0: at least as close as the source gets (0.98 cm, 0.11 deg)."""
    outcome = Loop(start, IDEAL, LARGE).drive(TensorOptions(phi_1="zero"), TAU_100, 120.0)
    assert outcome.finished
    assert outcome.position < 0.7e-2
    assert outcome.heading_deg < 0.1


@pytest.mark.parametrize("told_deg", [-30.0, 30.0])
def test_a_wrong_heading_of_the_start_does_no_harm(told_deg):
    """φ1 may be fixed anywhere between −30 and 30 deg (p. 60); `reproduce phi-1` takes them all."""
    told = TensorOptions(phi_1="given", phi_1_deg=told_deg)
    outcome = Loop(TABLE_3_1[0], IDEAL, LARGE).drive(told, TAU_100, 130.0)
    assert outcome.finished
    assert outcome.position < 1e-3
    assert outcome.heading_deg < 0.05


@pytest.mark.parametrize("start", TABLE_3_1[::3])
def test_published_starts_with_one_pixel_of_noise(start):
    outcome = Loop(start, MockOptions(ideal=True, noise_px=1.0), LARGE).drive(
        law=TAU_100, duration=120.0
    )
    assert outcome.finished
    assert outcome.position < 0.02
    assert outcome.heading_deg < 0.3


@pytest.mark.parametrize("start", TABLE_3_1[:2])
def test_published_law_on_estimated_tensors(start):
    """The discontinuous law ends where its source says: in its own chatter of ±1 cm."""
    law = TrifocalSmcOptions(law="published", tau_s=100.0, finish="time", advance_m=0.0)
    outcome = Loop(start, IDEAL, LARGE).drive(law=law, duration=125.0)
    assert outcome.finished
    assert outcome.duration == pytest.approx(120.0, abs=0.3)
    assert abs(outcome.error.x) < 0.013
    assert abs(outcome.error.y) < 0.015
    assert outcome.heading_deg < 0.2


@pytest.mark.parametrize("method", ["linear5", "refined"])
def test_other_methods_reach_the_target(method):
    loop = Loop((1.0, -5.0, -8.0), IDEAL, LARGE)
    outcome = loop.drive(TensorOptions(method=method), TrifocalSmcOptions(tau_s=20.0))
    assert outcome.finished
    assert outcome.position < 0.01
    assert outcome.heading_deg < 0.2


def test_short_tasks_with_a_real_base():
    """A tenth of a second late, ramped, in whole units, 0.3 px of noise; they face first."""
    errors, angles = [], []
    mock = MockOptions(noise_px=0.3, near_m=1.5, far_m=5.0, actuation=REAL)
    for seed, start in enumerate(short_starts(8)):
        loop = Loop(start, mock, seed=seed)
        assert loop.face().finished
        outcome = loop.drive()
        assert outcome.finished
        errors.append(outcome.position)
        angles.append(outcome.heading_deg)
    assert np.quantile(errors, 0.95) < 0.01
    assert np.quantile(angles, 0.95) < 0.3
    assert np.median(errors) < 0.004
    assert np.median(angles) < 0.1


def test_commands_are_what_the_base_executes():
    """Within limits and ramps, in whole units: nothing is left for the base to clip."""
    limits = load_robot("p3dx").operating
    loop = Loop((-0.55, -1.35, -22.0), MockOptions(noise_px=0.3, actuation=REAL))
    outcome = loop.drive()
    v = np.array([sent.v for sent in outcome.sent])
    omega = np.degrees([sent.omega for sent in outcome.sent])
    np.testing.assert_allclose(v * 1000, np.round(v * 1000), atol=1e-6)
    np.testing.assert_allclose(omega, np.round(omega), atol=1e-6)
    assert np.abs(v).max() <= limits.v_m_s + 1e-9
    assert np.abs(np.diff(v)).max() <= limits.acceleration_m_s2 * 0.1 + 2e-3
    assert np.abs(np.diff(omega)).max() <= limits.angular_acceleration_deg_s2 * 0.1 + 2.0


def test_no_chatter_at_the_end():
    """In the last two seconds the speed changes by millimetres a second, not by centimetres."""
    loop = Loop((-0.55, -1.35, -22.0), MockOptions(noise_px=0.3, actuation=REAL))
    outcome = loop.drive()
    v = np.array([sent.v for sent in outcome.sent[-20:]])
    assert np.abs(np.diff(v)).mean() < 6e-3


def test_an_offset_camera_reaches_its_pose():
    """The camera 0.1 m ahead of the axle: turning on the spot must not carry it away."""
    loop = Loop((-0.4, -1.6, -14.0), MockOptions(noise_px=0.1, actuation=REAL), mount="front")
    outcome = loop.drive()
    assert outcome.finished
    assert outcome.position < 0.01
    assert outcome.heading_deg < 0.3


def test_phases_in_order():
    outcome = Loop((-0.3, -1.5, -11.0), MockOptions(actuation=REAL)).drive()
    assert list(dict.fromkeys(outcome.phases)) == ["advance", "position", "orientation"]


def test_same_seed_same_bits():
    mock = MockOptions(noise_px=0.5, actuation=REAL)
    first, second = (Loop((-0.3, -1.5, -11.0), mock, seed=4).drive() for _ in range(2))
    assert first.sent == second.sent
    assert first.error == second.error


def controller(**options):
    limits = load_robot("p3dx").operating
    context = Context(LARGE, limits, 0.0, 0.1, 0, True)
    return TrifocalSmc(TrifocalSmcOptions(**options), context)


def estimates(seed=0):
    """Estimates along a straight drive from 1.5 m, recorded once."""
    loop = Loop((0.0, -1.5, 0.0), MockOptions(noise_px=0.3, actuation=REAL), seed=seed)
    estimator = Tensor(TensorOptions(), loop.context)
    views = loop.perception.update(loop.backend.camera.read())
    return estimator.update(views, STANDSTILL, 0.0)


def test_lost_features_stop_the_robot_and_its_clock():
    law, good = controller(advance_m=0.0), estimates()
    for _ in range(5):
        law.update(good, STANDSTILL, 0.1)
    progress = law.values()["progress"]
    lost = replace(good, health=Health.LOST)
    decision = law.update(lost, STANDSTILL, 0.1)
    assert decision.velocity == STANDSTILL
    assert not decision.finished
    for _ in range(20):
        law.update(lost, STANDSTILL, 0.1)
    assert law.update(good, STANDSTILL, 0.1).phase == "position"
    assert law.values()["progress"] <= progress + 0.2


def test_a_tensor_that_never_comes_stops_the_advance():
    law = controller(advance_m=0.2, advance_m_s=0.2)
    nothing = replace(estimates(), health=Health.DEGENERATE)
    travelled, velocity = 0.0, STANDSTILL
    for _ in range(60):
        travelled += velocity.v * 0.1
        velocity = law.update(nothing, velocity, 0.1).velocity
    assert velocity == STANDSTILL
    assert 0.2 < travelled < 0.5


def test_never_finished_by_a_wrong_measurement_elsewhere():
    """Far from the target by its own measurement, the controller never says that it is there."""
    law, far = controller(advance_m=0.0, tau_s=0.5), estimates()
    assert not any(law.update(far, STANDSTILL, 0.1).finished for _ in range(300))


def test_the_reference_waits_for_a_robot_at_its_limits():
    """Five metres in five seconds cannot be: the clock of step 1 slows down, and it arrives."""
    loop = Loop((0.3, -5.0, 3.0), MockOptions(noise_px=0.1, actuation=REAL), LARGE)
    outcome = loop.drive(law=TrifocalSmcOptions(tau_s=5.0), duration=60.0)
    assert outcome.finished
    assert outcome.duration > 5.0 / 0.4
    assert outcome.position < 0.01
    assert math.degrees(abs(outcome.error.phi)) < 0.3


def test_a_wrong_calibration_does_not_move_the_goal():
    """ξ wrong by 0.1 and the focal length by 5 %: the fixed point is where the views agree."""
    true = load_camera("hypercatadioptric")
    believed = true.altered(xi=true.xi - 0.1, fx=true.fx * 0.95, fy=true.fy * 0.95)
    for seed, start in enumerate(short_starts(3, seed=1)):
        mock = MockOptions(noise_px=0.3, near_m=1.5, far_m=5.0, actuation=REAL)
        loop = Loop(start, mock, believed, true_camera=true, seed=seed)
        loop.face()
        outcome = loop.drive()
        assert outcome.finished
        assert outcome.position < 0.012
        assert outcome.heading_deg < 0.3


def test_bearings_alone_reach_the_target():
    loop = Loop((-0.4, -1.8, -13.0), MockOptions(noise_px=0.3, near_m=1.5, far_m=5.0))
    outcome = loop.drive(TensorOptions(elevations=False))
    assert outcome.finished
    assert outcome.position < 0.01
    assert outcome.heading_deg < 0.3
