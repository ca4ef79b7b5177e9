"""What every backend must do, whatever is behind it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from visctrl.hal.errors import LinkError
from visctrl.hal.interfaces import Backend
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.runtime.config import Override, load_scenario
from visctrl.runtime.plan import make_plan
from visctrl.runtime.registry import REGISTRIES

NAMES = ["mock", pytest.param("sim", marks=pytest.mark.sim)]
START = (0.3, -1.5, 5.0)

Open = Callable[..., Backend]


@pytest.fixture(params=NAMES)
def unopened(request: pytest.FixtureRequest) -> Iterator[Open]:
    """Return a function that builds the backend from settings; it is closed at the end."""
    made: list[Backend] = []

    def make(**settings: object) -> Backend:
        name = request.param
        values = {
            "backend": name,
            "start.x_m": START[0],
            "start.y_m": START[1],
            "start.phi_deg": START[2],
            "camera.width": 400,
            "approach.enabled": False,
            **{key.replace("__", "."): value for key, value in settings.items()},
        }
        overrides = [
            Override(tuple(key.replace("backend_", name + ".").split(".")), value, "--set")
            for key, value in values.items()
        ]
        loaded = load_scenario("default", overrides, REGISTRIES.backends.names())
        backend = make_plan(loaded).open_backend()
        made.append(backend)
        return backend

    yield make
    for backend in made:
        backend.close()


@pytest.fixture
def opened(unopened: Open) -> Open:
    def make(**settings: object) -> Backend:
        backend = unopened(**settings)
        backend.open()
        return backend

    return make


def test_the_robot_stands_at_its_start(opened: Open) -> None:
    backend = opened()
    truth = backend.truth()
    assert truth is not None
    assert truth == pytest.approx((*START[:2], math.radians(START[2])), abs=2e-3)
    assert backend.base.odometry().velocity == pytest.approx(STANDSTILL, abs=1e-3)
    assert backend.collisions() == 0
    assert backend.base.status().faults == ()


def test_frames_are_stamped_numbered_and_of_the_calibrations_size(opened: Open) -> None:
    backend = opened()
    clock, camera = backend.clock, backend.camera
    previous = camera.read()
    for k in range(1, 4):
        clock.sleep_until(0.1 * k)
        frame = camera.read()
        assert frame.stamp == pytest.approx(0.1 * k, abs=0.02)
        assert frame.stamp <= clock.now()
        assert frame.sequence > previous.sequence
        previous = frame
    if backend.delivers_features:
        assert previous.features is not None
        ids = previous.features.ids
        assert (np.diff(ids) > 0).all()
        assert previous.features.pixels.shape == (len(ids), 2)
    else:
        assert previous.image is not None
        assert previous.image.shape == (camera.model.height, camera.model.width)
        assert previous.image.dtype == np.uint8


def test_time_is_lockstepped_and_lands_on_the_deadline(opened: Open) -> None:
    backend = opened()
    assert backend.clock.lockstep
    began = backend.clock.now()
    backend.clock.sleep_until(began + 0.3)
    assert backend.clock.now() == began + 0.3
    backend.clock.sleep_until(began)
    assert backend.clock.now() == began + 0.3


def test_a_command_moves_the_robot_forward_and_odometry_agrees(opened: Open) -> None:
    backend = opened()
    sent = backend.base.command(Velocity(0.2, 0.0))
    assert sent == pytest.approx((0.2, 0.0))
    backend.clock.sleep_until(2.0)
    truth = backend.truth()
    assert truth is not None
    heading = math.radians(START[2])
    ahead = -(truth.x - START[0]) * math.sin(heading) + (truth.y - START[1]) * math.cos(heading)
    aside = (truth.x - START[0]) * math.cos(heading) + (truth.y - START[1]) * math.sin(heading)
    assert 0.2 < ahead < 0.4, "a ramp, then 0.2 m/s"
    assert abs(aside) < 0.01
    odometry = backend.base.odometry()
    assert odometry.pose.y == pytest.approx(ahead, abs=0.01)
    assert odometry.velocity.v == pytest.approx(0.2, abs=0.01)


def test_turning_is_counter_clockwise(opened: Open) -> None:
    backend = opened()
    backend.base.command(Velocity(0.0, 0.3))
    backend.clock.sleep_until(1.0)
    truth = backend.truth()
    assert truth is not None
    assert 0.15 < truth.phi - math.radians(START[2]) < 0.3


def test_what_is_sent_is_bounded_and_in_whole_units(opened: Open) -> None:
    backend = opened()
    limits = backend.robot.operating
    sent = backend.base.command(Velocity(7.0, 3.0))
    assert abs(sent.v) <= limits.v_m_s + 1e-9
    assert abs(sent.omega) <= limits.omega_rad_s + 1e-9
    sent = backend.base.command(Velocity(0.12345, 0.12345))
    assert 1000.0 * sent.v == pytest.approx(round(1000.0 * sent.v))
    assert math.degrees(sent.omega) == pytest.approx(round(math.degrees(sent.omega)))


def test_stop_brings_the_robot_to_a_standstill(opened: Open) -> None:
    backend = opened()
    backend.base.command(Velocity(0.3, 0.2))
    backend.clock.sleep_until(1.5)
    backend.base.stop()
    backend.clock.sleep_until(4.0)
    before = backend.truth()
    backend.clock.sleep_until(5.0)
    assert backend.truth() == pytest.approx(before, abs=1e-3)
    assert backend.base.odometry().velocity == pytest.approx(STANDSTILL, abs=1e-3)


def test_teaching_gives_frames_of_the_target_and_leaves_the_robot_at_its_start(
    opened: Open,
) -> None:
    backend = opened()
    before = backend.truth()
    frames = backend.teach(2)
    assert len(frames) == 2
    assert backend.truth() == pytest.approx(before, abs=2e-3)
    assert backend.base.odometry().pose == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    first, second = frames
    if first.image is not None:
        assert second.image is not None
        assert not np.array_equal(first.image, second.image), "each frame has its own noise"


def test_a_frozen_camera_repeats_its_frame(opened: Open) -> None:
    backend = opened(backend_faults__camera_frozen_s=[0.15, 10.0])
    numbers = []
    for k in range(4):
        backend.clock.sleep_until(0.1 * k)
        numbers.append(backend.camera.read().sequence)
    assert numbers[0] < numbers[1] == numbers[2] == numbers[3]


def test_a_dead_link_is_a_link_error(opened: Open) -> None:
    backend = opened(backend_faults__link_dead_s=[0.5, 1.0])
    backend.base.command(Velocity(0.1, 0.0))
    backend.clock.sleep_until(0.6)
    with pytest.raises(LinkError):
        backend.base.command(Velocity(0.1, 0.0))
    backend.clock.sleep_until(1.1)
    backend.base.stop()


def test_same_seed_same_frames(opened: Open) -> None:
    def look(seed: int) -> np.ndarray[tuple[int, ...], np.dtype[np.generic]]:
        backend = opened(seed=seed)
        backend.base.command(Velocity(0.2, 0.1))
        backend.clock.sleep_until(0.5)
        frame = backend.camera.read()
        backend.close()
        if frame.image is not None:
            return frame.image
        assert frame.features is not None
        return frame.features.pixels

    first, again, other = look(3), look(3), look(4)
    assert np.array_equal(first, again)
    assert first.shape != other.shape or not np.array_equal(first, other)


def test_leaving_the_context_closes_even_after_an_exception(unopened: Open) -> None:
    backend = unopened()
    with pytest.raises(ZeroDivisionError), backend:
        raise ZeroDivisionError
    assert backend.truth() is None
    backend.close()


def test_closing_before_opening_is_fine(unopened: Open) -> None:
    unopened().close()
