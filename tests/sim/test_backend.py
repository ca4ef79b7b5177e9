"""The simulated backend: one world behind camera, base and clock, with faults on demand."""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.errors import CameraError, InputError, LinkError
from visctrl.hal.interfaces import BackendSetup
from visctrl.hal.types import Frame, Pose, Velocity
from visctrl.robots import Limits, load_robot
from visctrl.sim.backend import SimBackend
from visctrl.sim.options import RendererName, SimOptions
from visctrl.sim.render.renderer_choice import drawer_problem

pytestmark = pytest.mark.sim
START = Pose(-0.55, -1.35, math.radians(-35.0))
CAMERA = load_camera("paracatadioptric").resized(200, 150)
P3DX = load_robot("p3dx")
SMALL_ROOM = str(Path(__file__).with_name("small_room.yaml"))


def build(
    start: Pose = START,
    seed: int = 3,
    realtime: bool = False,
    limits: Limits | None = P3DX.operating,
    mount: str = "centre",
    **options: object,
) -> SimBackend:
    settings = SimOptions.model_validate({"scene": SMALL_ROOM, "show_floor": False, **options})
    return SimBackend(
        BackendSetup(
            P3DX, P3DX.mount(mount), CAMERA, CAMERA, start, limits, settings, seed, realtime
        )
    )


@contextmanager
def opened(**settings: object) -> Iterator[SimBackend]:
    with build(**settings) as backend:  # type: ignore[arg-type]
        yield backend


def drive(backend: SimBackend, velocity: Velocity, until: float) -> list[Frame]:
    """Tick at 10 Hz to a time; return the frames."""
    frames = []
    while backend.clock.now() < until - 1e-9:
        frames.append(backend.camera.read())
        backend.base.command(velocity)
        backend.clock.sleep_until(backend.clock.now() + 0.1)
    return frames


def pixels(frame: Frame) -> np.ndarray:
    assert frame.image is not None
    return frame.image


def test_teaching_visits_the_target_and_returns() -> None:
    with opened() as backend:
        frames = backend.teach(2)
        assert pixels(frames[0]).shape == (150, 200)
        assert not np.array_equal(pixels(frames[0]), pixels(frames[1]))
        assert np.allclose(backend.truth() or (), START, atol=1e-4)
        assert backend.clock.now() == 0.0
    with opened(start=Pose(0.0, 0.0, 0.0), image_noise=0.0) as there:
        seen = pixels(there.camera.read()).astype(float)
    with opened(image_noise=0.0) as backend:
        taught = pixels(backend.teach()[0]).astype(float)
    assert np.mean(np.abs(seen - taught) > 4) < 0.01


renderers = pytest.mark.parametrize("renderer", ["tiny", "gl"])


def skip_without(renderer: RendererName) -> None:
    if problem := drawer_problem(renderer):
        pytest.skip(problem)


@renderers
def test_the_same_seed_gives_the_same_bits(renderer: RendererName) -> None:
    skip_without(renderer)
    runs = []
    for seed in (3, 3, 4):
        with opened(seed=seed, renderer=renderer) as backend:
            backend.teach()
            frames = drive(backend, Velocity(0.2, 0.1), 0.5)
            runs.append((frames, backend.truth(), backend.base.odometry()))
    (a, truth_a, odometry_a), (b, truth_b, odometry_b), (c, truth_c, _) = runs
    assert all(np.array_equal(pixels(x), pixels(y)) for x, y in zip(a, b, strict=True))
    assert (truth_a, odometry_a) == (truth_b, odometry_b)
    assert not np.array_equal(pixels(a[0]), pixels(c[0]))
    assert truth_a == truth_c


@pytest.mark.parametrize("mount", ["centre", "front"])
def test_truth_is_the_cameras_pose(mount: str) -> None:
    with opened(mount=mount) as backend:
        assert np.allclose(backend.truth() or (), START, atol=1e-4)
        ell = P3DX.mounts[mount].forward_m
        drive(backend, Velocity(0.0, math.radians(20.0)), 2.0)
        truth = backend.truth()
        assert truth is not None
        # The axle stays; the camera circles round it.
        for pose in (START, truth):
            axle = (pose.x + ell * math.sin(pose.phi), pose.y - ell * math.cos(pose.phi))
            assert axle == pytest.approx(
                (START.x + ell * math.sin(START.phi), START.y - ell * math.cos(START.phi)), abs=2e-3
            )
        assert truth.phi - START.phi > math.radians(25.0)


def test_frames_are_read_only_when_asked_for_and_once_per_instant() -> None:
    with opened() as backend:
        first = backend.camera.read()
        assert backend.camera.read() is first
        backend.clock.sleep_until(0.1)
        backend.clock.sleep_until(0.2)
        second = backend.camera.read()
        assert second.sequence == first.sequence + 1
        assert second.stamp == 0.2


def test_slip_is_not_noticed_by_odometry() -> None:
    slip = {"slip_v": 0.2, "slip_omega": 0.0}
    with opened(actuation=slip) as backend:
        drive(backend, Velocity(0.2, 0.0), 3.0)
        truth = backend.truth()
        assert truth is not None
        moved = math.hypot(truth.x - START.x, truth.y - START.y)
        believed = backend.base.odometry().pose.y
    assert moved == pytest.approx(0.8 * believed, rel=0.01)


def test_commands_act_after_their_delay() -> None:
    with opened(actuation={"delay_s": 0.5}) as backend:
        backend.base.command(Velocity(0.3, 0.0))
        backend.clock.sleep_until(0.5)
        assert np.allclose(backend.truth() or (), START, atol=1e-4)
        backend.clock.sleep_until(1.5)
        assert backend.base.odometry().velocity.v > 0.2


def test_a_base_without_limits_has_no_ramp() -> None:
    with opened(limits=None, actuation={"quantise": False}) as backend:
        assert backend.base.command(Velocity(0.1234567, 0.0)).v == 0.1234567
        backend.clock.sleep_until(0.3)
        assert backend.base.odometry().velocity.v == pytest.approx(0.1234567, rel=0.01)


def test_running_into_furniture_is_counted() -> None:
    # Towards the column on the right.
    with opened(start=Pose(1.2, -2.5, math.radians(-90.0))) as backend:
        drive(backend, Velocity(0.3, 0.0), 1.0)
        assert backend.collisions() == 0
        for _ in range(60):
            backend.base.command(Velocity(0.3, 0.0))
            backend.clock.sleep_until(backend.clock.now() + 0.1)
        assert backend.collisions() >= 1


@renderers
def test_an_item_may_be_moved_into_the_way(renderer: RendererName) -> None:
    skip_without(renderer)
    start = Pose(0.0, -3.0, 0.0)
    with opened(start=start, image_noise=0.0, renderer=renderer) as backend:
        before = pixels(backend.camera.read())
        backend.move("right column", Pose(0.0, -1.8, 0.0))
        backend.clock.sleep_until(0.1)
        after = pixels(backend.camera.read())
        assert np.mean(np.abs(after.astype(float) - before) > 10) > 0.01
        for _ in range(60):
            backend.base.command(Velocity(0.3, 0.0))
            backend.clock.sleep_until(backend.clock.now() + 0.1)
        assert backend.collisions() >= 1
        with pytest.raises(InputError, match=r"no item 'colum'.*right column"):
            backend.move("colum", Pose(0.0, 0.0, 0.0))


def test_two_at_once_live_in_worlds_of_their_own() -> None:
    skip_without("gl")
    with opened(image_noise=0.0, renderer="gl") as alone:
        expected = [pixels(frame) for frame in drive(alone, Velocity(0.2, 0.1), 0.3)]
    other_start = Pose(0.5, -2.0, 0.4)
    with opened(image_noise=0.0, renderer="gl") as one:
        for image in expected:
            with opened(start=other_start, image_noise=0.0, renderer="gl") as other:
                other.move("poster", Pose(1.0, 1.0, 0.0))
                assert not np.array_equal(pixels(other.camera.read()), image)
                assert np.array_equal(pixels(one.camera.read()), image)
            one.base.command(Velocity(0.2, 0.1))
            one.clock.sleep_until(one.clock.now() + 0.1)


def test_a_start_in_furniture_starts_nothing() -> None:
    backend = build(start=Pose(2.6, -2.5, 0.0))
    with pytest.raises(InputError, match="would touch 'right column'"):
        backend.open()
    backend.close()


def test_frozen_black_and_dropped_frames() -> None:
    faults = {"camera_frozen_s": [0.25, 0.55], "camera_black_s": [0.75, 0.95]}
    with opened(faults=faults) as backend:
        frames = drive(backend, Velocity(0.2, 0.0), 1.2)
    assert [f.sequence for f in frames[2:6]] == [frames[2].sequence] * 4
    assert frames[5].stamp == frames[2].stamp
    assert frames[6].sequence > frames[2].sequence
    assert [bool(pixels(f).any()) for f in frames[7:11]] == [True, False, False, True]
    with opened(faults={"frame_drop_probability": 0.5}) as backend:
        frames = drive(backend, Velocity(0.0, 0.0), 2.0)
    assert 5 <= len({f.sequence for f in frames}) <= 16


def test_a_dead_link_refuses_commands_and_the_robot_goes_on() -> None:
    with opened(faults={"link_dead_s": [0.95, 2.0]}) as backend:
        drive(backend, Velocity(0.2, 0.0), 1.0)
        with pytest.raises(LinkError):
            backend.base.command(Velocity(0.0, 0.0))
        before = backend.truth()
        backend.clock.sleep_until(1.9)
        after = backend.truth()
        assert before is not None
        assert after is not None
        assert math.hypot(after.x - before.x, after.y - before.y) > 0.15
        # Leaving while the link is dead is no error.


def test_late_work_is_late_in_real_time() -> None:
    with opened(realtime=True) as backend:
        assert not backend.clock.lockstep
        backend.base.command(Velocity(0.3, 0.0))
        began = backend.clock.now()
        time.sleep(0.3)
        odometry = backend.base.odometry()
        assert odometry.stamp >= began + 0.3
        # The world has moved on meanwhile: half of 0.3 m/s² for 0.3 s and more.
        assert odometry.velocity.v >= 0.08
        deadline = backend.clock.now() + 0.05
        backend.clock.sleep_until(deadline)
        assert deadline <= backend.clock.now()


def test_closing_ends_everything_and_may_be_repeated() -> None:
    backend = build()
    backend.close()
    backend.open()
    base = backend.base
    backend.close()
    backend.close()
    assert backend.truth() is None
    with pytest.raises(LinkError, match="closed"):
        base.command(Velocity(0.1, 0.0))


def test_a_true_camera_of_another_size_is_refused() -> None:
    camera = load_camera("paracatadioptric")
    backend = SimBackend(
        BackendSetup(P3DX, P3DX.mount("centre"), CAMERA, camera, START, None, SimOptions())
    )
    with pytest.raises(CameraError, match="another size"):
        backend.open()
    backend.close()
