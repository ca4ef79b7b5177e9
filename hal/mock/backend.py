"""The mock backend: an exact unicycle that sees identified features through the true camera.

Milliseconds per run, for tests and for Monte Carlo studies. It imitates what spoils real runs
(pixel noise, whole units, delay, slip, dropped frames, a dead link) only when told to.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from enum import IntEnum
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field, model_validator

from visctrl.hal.actuation import Actuation, ActuationOptions, Scatter
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.clock import WallClock, WorldClock
from visctrl.hal.errors import LinkError
from visctrl.hal.faults import Faults, FaultyCapture, check_link
from visctrl.hal.interfaces import Backend, BackendOptions, BackendSetup, Base, Camera
from visctrl.hal.mock.scene import scatter, view_matrix
from visctrl.hal.types import STANDSTILL, Features, Frame, Odometry, Pose, Velocity
from visctrl.robots import Limits
from visctrl.robots.unicycle import along_arc, wrapped

#: Longest step of the motion while delays and ramps shape it, and one that is none (s).
_STEP_S, _INSTANT_S = 0.01, 1e-12
_EXACT = ActuationOptions(quantise=False)

Metres = Annotated[float, Field(gt=0.0)]


class Purpose(IntEnum):
    """What the mock draws random numbers for, each from a generator of its own."""

    SCENE, NOISE, TEACHING, DROPS, SCATTER = range(5)

    def generator(self, seed: int) -> np.random.Generator:
        """Return the generator of a run with this seed."""
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(self.value,)))


class MockOptions(BackendOptions):
    """Scene, camera noise and actuation of the mock.

    features : number of points in the scene.
    near_m, far_m : how far the points are from the way to the target (from the target, for a
        camera that looks ahead).
    noise_px : standard deviation of a feature's position in each image coordinate.
    scatter : of the executed motion; the wheels do not notice it.
    ideal : no speed limits, ramps, quantisation, delay or slip, as in published simulations.
    """

    flags: ClassVar[Mapping[str, str]] = {"--noise-px": "noise_px"}

    features: Annotated[int, Field(ge=1, le=100_000)] = 60
    near_m: Metres = 2.0
    far_m: Metres = 8.0
    noise_px: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0
    scatter: Scatter = Scatter()
    ideal: bool = False
    actuation: ActuationOptions = ActuationOptions()
    faults: Faults = Faults()

    @model_validator(mode="after")
    def _consistent(self) -> MockOptions:
        if self.near_m >= self.far_m:
            raise ValueError(f"near_m {self.near_m:g} must be less than far_m {self.far_m:g}")
        if self.ideal and self.actuation != ActuationOptions():
            raise ValueError("an ideal robot has no actuation to set: drop 'ideal' or 'actuation'")
        return self


class MockBackend(Backend):
    """A simulated robot without physics or rendering (see `Backend`)."""

    Options: ClassVar[type[MockOptions]] = MockOptions
    delivers_features = True

    def __init__(self, setup: BackendSetup[MockOptions]) -> None:
        super().__init__(setup)
        self._motion: _Motion | None = None

    @classmethod
    def kept_limits(cls, limits: Limits, options: MockOptions) -> Limits | None:
        """See `Backend.kept_limits`: an ideal robot has none."""
        return None if options.ideal else limits

    def open(self) -> None:
        """Scatter the scene and put the robot at its start.

        Raises
        ------
        InputError
            Start and target see too little in common.
        """
        setup, options = self.setup, self.setup.options
        points = scatter(
            options.features,
            (options.near_m, options.far_m),
            setup.true_camera,
            setup.mount,
            setup.start,
            Purpose.SCENE.generator(setup.seed),
        )
        motion = _Motion(
            setup.start,
            setup.mount.forward_m,
            None if options.ideal else setup.limits,
            _EXACT if options.ideal else options.actuation,
            options.scatter.drawer(Purpose.SCATTER.generator(setup.seed)),
            self.robot.wheels.effective_track_m,
        )
        clock = WorldClock(motion.advance, WallClock() if setup.realtime else None)
        drops = FaultyCapture(options.faults, Purpose.DROPS.generator(setup.seed))
        projector = _Projector(points, setup.true_camera, options.noise_px)
        self._motion, self.clock = motion, clock
        self.camera = MockCamera(
            setup.camera, projector, motion, clock, drops, Purpose.NOISE.generator(setup.seed)
        )
        self.base = MockBase(motion, clock, options.faults)
        self._projector = projector
        self._teach_rng = Purpose.TEACHING.generator(setup.seed)

    def close(self) -> None:
        """Stop the robot; its base takes no more commands."""
        if self._motion is not None:
            self._motion.halt()
            self._motion = None
            self.base.connected = False

    def teach(self, count: int = 1) -> list[Frame]:
        """Return ``count`` frames from the target pose, each with its own noise."""
        origin = Pose(0.0, 0.0, 0.0)
        return [
            Frame(self.clock.now(), k, features=self._projector.image(origin, self._teach_rng))
            for k in range(count)
        ]

    def truth(self) -> Pose | None:
        """Return the camera's true pose in the target's frame; None when closed."""
        if self._motion is None:
            return None
        self.clock.synchronise()
        return self._motion.camera_pose()

    # Narrower than the interface: what this backend really has.
    setup: BackendSetup[MockOptions]
    camera: MockCamera
    clock: WorldClock
    base: MockBase


class MockCamera(Camera):
    """Sees the identified features of the scene, noise and faults included."""

    def __init__(
        self,
        model: CentralCamera,
        projector: _Projector,
        motion: _Motion,
        clock: WorldClock,
        capture: FaultyCapture,
        rng: np.random.Generator,
    ) -> None:
        super().__init__(model)
        self._projector = projector
        self._motion = motion
        self._clock = clock
        self._capture = capture
        self._rng = rng
        self._sequence = 0
        self._newest: Frame | None = None
        self._read_at = -math.inf

    def read(self) -> Frame:
        """Return a frame exposed now; at the same instant, the same frame."""
        now = self._clock.synchronise()
        if self._newest is None or now > self._read_at:
            self._newest = self._capture.deliver(now, lambda: self._expose(now))
            self._read_at = now
        return self._newest

    def _expose(self, now: float) -> Frame:
        self._sequence += 1
        features = self._projector.image(self._motion.camera_pose(), self._rng)
        return Frame(now, self._sequence, features=features)


class MockBase(Base):
    """Executes commands on the exact unicycle."""

    def __init__(self, motion: _Motion, clock: WorldClock, faults: Faults) -> None:
        self._motion = motion
        self._clock = clock
        self._faults = faults
        self.whole_units = motion.actuation.whole_units
        self.connected = True

    def command(self, velocity: Velocity) -> Velocity:
        """Set the velocity; return it after limits and quantisation.

        Raises
        ------
        LinkError
            The link is dead, or the backend is closed.
        """
        if not self.connected:
            raise LinkError("the mock base is closed")
        now = self._clock.synchronise()
        check_link(self._faults, now)
        return self._motion.actuation.request(now, velocity)

    def odometry(self) -> Odometry:
        """Return the pose that the wheels report: slip goes unnoticed."""
        now = self._clock.synchronise()
        return Odometry(now, self._motion.wheel_pose(), self._motion.set_point)


class _Projector:
    """Images of the scene's points in the true camera."""

    def __init__(
        self, points: np.ndarray[tuple[int, int]], camera: CentralCamera, noise: float
    ) -> None:
        self.points = points
        self._camera = camera
        self.noise = noise
        self._homogeneous = np.column_stack([points, np.ones(len(points))])
        self._ids = np.arange(len(points), dtype=np.int64)

    def image(self, pose: Pose, rng: np.random.Generator) -> Features:
        pixels, seen = self._camera.robot_pixels(self._homogeneous @ view_matrix(pose))
        if self.noise > 0.0:
            pixels += rng.normal(scale=self.noise, size=pixels.shape)
        if seen.all():
            return Features(self._ids, pixels)
        return Features(self._ids[seen], pixels[seen])


class _Motion:
    """True and dead-reckoned pose of the robot under the commands it is given."""

    def __init__(
        self,
        start: Pose,
        offset: float,
        limits: Limits | None,
        options: ActuationOptions,
        scatter: Callable[[], Velocity],
        track_m: float,
    ) -> None:
        self.actuation = Actuation(limits, options)
        self.set_point = STANDSTILL
        self._options = options
        self._scatter = scatter
        self._track_m = track_m
        self._offset = offset
        self._time = 0.0
        self._wheels = (0.0, 0.0, 0.0)
        # The axle's centre is what moves on the arc; the camera sits ``offset`` ahead of it.
        s, c = math.sin(start.phi), math.cos(start.phi)
        self._axle = (start.x + offset * s, start.y - offset * c, start.phi)
        self._instant = limits is None and options.delay_s == 0.0

    def advance(self, dt: float) -> None:
        """Move on by ``dt`` (s) along exact arcs."""
        end = self._time + dt
        scatter = self._scatter()
        while (left := end - self._time) > _INSTANT_S:
            step = left if self._instant or self.actuation.steady else min(left, _STEP_S)
            self.set_point = self.actuation.velocity_at(self._time, step)
            executed = self._options.executed(self.set_point, self._track_m)
            if scatter != STANDSTILL and executed != STANDSTILL:
                executed = Velocity(executed.v + scatter.v, executed.omega + scatter.omega)
            self._axle = along_arc(self._axle, executed, step)
            self._wheels = along_arc(self._wheels, self.set_point, step)
            self._time += step
        self._time = end

    def camera_pose(self) -> Pose:
        x, y, phi = self._axle
        offset = self._offset
        return Pose(x - offset * math.sin(phi), y + offset * math.cos(phi), wrapped(phi))

    def wheel_pose(self) -> Pose:
        x, y, phi = self._wheels
        return Pose(x, y, wrapped(phi))

    def halt(self) -> None:
        self.actuation.halt()
        self.set_point = STANDSTILL
