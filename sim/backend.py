"""The simulated robot: PyBullet's physics, rendered images, and a clock that steps them."""

from __future__ import annotations

import math
import time

import numpy as np

from hal.actuation import Actuation
from hal.central_camera import CentralCamera
from hal.errors import CameraError, LinkError
from hal.faults import FaultyCapture, check_link
from hal.interfaces import Backend, Base, Camera, Clock
from hal.types import Frame, Odometry, Pose, Velocity
from robots import Limits, Robot
from robots.model import Mount
from robots.unicycle import step_exact
from sim.imaging import Sensor
from sim.options import SimOptions
from sim.physics import STEPS_PER_SECOND, Physics
from sim.renderer import BulletRenderer, Renderer, choose_drawer
from sim.scene import Scene, load_scene

_STEP_S = 1.0 / STEPS_PER_SECOND
_TARGET = Pose(0.0, 0.0, 0.0)
#: A world this far behind the wall clock is caught up, not more: beyond, time itself is late.
_STEP_TOLERANCE = 1e-6


class World:
    """Everything simulated, advanced to a time on demand.

    Time counts from the opening of the backend. The wheels follow the actuation's set-point in
    every physics step, less the slip that odometry does not notice.
    """

    def __init__(
        self,
        physics: Physics,
        renderer: Renderer,
        sensor: Sensor,
        actuation: Actuation,
        options: SimOptions,
        mount: Mount,
    ) -> None:
        self.physics = physics
        self.actuation = actuation
        self._renderer = renderer
        self._sensor = sensor
        self._options = options.actuation
        self._mount = mount
        self._steps = 0
        self._sequence = 0
        self._dead_reckoned = Pose(0.0, 0.0, 0.0)
        self._measured = Velocity(0.0, 0.0)

    @property
    def time(self) -> float:
        """Simulated time (s)."""
        return self._steps * _STEP_S

    def advance(self, t: float) -> None:
        """Step the physics until ``t`` (s)."""
        while self._steps + _STEP_TOLERANCE < t * STEPS_PER_SECOND:
            set_point = self.actuation.velocity_at(self.time, _STEP_S)
            self.physics.drive(self._options.executed(set_point))
            self.physics.step()
            self._reckon()
            self._steps += 1

    def skip(self, t: float) -> None:
        """Let time pass to ``t`` (s) while the world stands still (somebody carries the robot)."""
        self._steps = max(self._steps, math.ceil(t * STEPS_PER_SECOND - _STEP_TOLERANCE))

    def put(self, camera: Pose) -> None:
        """Put the robot down at rest with its camera at ``camera``; odometry starts anew."""
        self.actuation.halt()
        self.physics.put(Pose(*step_exact(camera, -self._mount.forward_m, 0.0, 1.0)))
        self._dead_reckoned = Pose(0.0, 0.0, 0.0)
        self._measured = Velocity(0.0, 0.0)

    def camera_pose(self) -> Pose:
        """Return where the camera is, in the target's frame."""
        ahead = step_exact(self.physics.axle(), self._mount.forward_m, 0.0, 1.0)
        return Pose(*ahead.tolist())

    def odometry(self) -> Odometry:
        """Return the camera point's dead-reckoned pose since the robot was put down."""
        return Odometry(self.time, self._dead_reckoned, self._measured)

    def photograph(self, stamp: float) -> Frame:
        """Return a new frame."""
        ideal = self._renderer.render(self.camera_pose(), self._mount.height_m)
        self._sequence += 1
        return Frame(stamp, self._sequence, self._sensor.expose(ideal, stamp, self._sequence))

    def close(self) -> None:
        """Release both PyBullet clients."""
        self._renderer.close()
        self.physics.close()

    def _reckon(self) -> None:
        wheels = self.physics.wheel_velocity()
        self._measured = Velocity(
            wheels.v / (1.0 - self._options.slip_v),
            wheels.omega / (1.0 - self._options.slip_omega),
        )
        pose = self._dead_reckoned
        middle = pose.phi + self._measured.omega * _STEP_S / 2
        self._dead_reckoned = Pose(
            pose.x - self._measured.v * _STEP_S * math.sin(middle),
            pose.y + self._measured.v * _STEP_S * math.cos(middle),
            pose.phi + self._measured.omega * _STEP_S,
        )


class SteppedClock(Clock):
    """Time that passes only while somebody waits for it: the world advances as fast as it can."""

    lockstep = True

    def __init__(self, world: World) -> None:
        self._world = world
        self._now = 0.0

    def now(self) -> float:
        """See `Clock.now`."""
        return self._now

    def sleep_until(self, deadline: float) -> None:
        """See `Clock.sleep_until`."""
        if deadline > self._now:
            self._world.advance(deadline)
            self._now = deadline


class WallClock(Clock):
    """The wall's time, which the world follows: work that takes long is late."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._start = time.perf_counter()

    def now(self) -> float:
        """See `Clock.now`."""
        return time.perf_counter() - self._start

    def sleep_until(self, deadline: float) -> None:
        """See `Clock.sleep_until`."""
        wait = deadline - self.now()
        if wait > 0.0:
            time.sleep(wait)
        self._world.advance(self.now())


class SimCamera(Camera):
    """The simulated camera. A frame is rendered only when it is read."""

    def __init__(
        self, model: CentralCamera, world: World, clock: Clock, capture: FaultyCapture
    ) -> None:
        super().__init__(model)
        self._world = world
        self._clock = clock
        self._capture = capture
        self._newest: Frame | None = None

    def read(self) -> Frame:
        """See `Camera.read`. Reading twice at one instant gives one frame."""
        now = self._clock.now()
        if self._newest is not None and self._newest.stamp == now:
            return self._newest
        self._world.advance(now)
        frame = self._capture.deliver(now, lambda: self._world.photograph(now))
        self._newest = frame
        return frame


class SimBase(Base):
    """The simulated base."""

    def __init__(self, world: World, clock: Clock, options: SimOptions) -> None:
        self._world = world
        self._clock = clock
        self._faults = options.faults

    def command(self, velocity: Velocity) -> Velocity:
        """See `Base.command`."""
        now = self._clock.now()
        self._world.advance(now)
        check_link(self._faults, now)
        return self._world.actuation.request(now, velocity)

    def odometry(self) -> Odometry:
        """See `Base.odometry`."""
        self._world.advance(self._clock.now())
        return self._world.odometry()


class SimBackend(Backend):
    """A robot in a PyBullet scene with a rendered camera.

    Parameters
    ----------
    robot : Robot
        Body and wheels.
    camera : CentralCamera
        The calibration that the robot believes in.
    true_camera : CentralCamera
        What its images are really made with.
    mount : Mount
        Where the camera sits.
    start : Pose
        Camera pose at the start, in the target's frame.
    limits : Limits or None
        Bounds of the base; None for one without bounds and ramp.
    options : SimOptions
        Scene, renderer, sensor, actuation, faults.
    seed : int
        Of image noise, exposure and dropped frames. The scene has its own.
    realtime : bool
        Follow the wall clock instead of stepping as fast as possible.
    """

    def __init__(
        self,
        robot: Robot,
        camera: CentralCamera,
        true_camera: CentralCamera,
        mount: Mount,
        start: Pose,
        limits: Limits | None,
        options: SimOptions,
        seed: int,
        realtime: bool,
    ) -> None:
        self.robot = robot
        self._model = camera
        self._true_model = true_camera
        self._mount = mount
        self._start = start
        self._limits = limits
        self._options = options
        self._seed = seed
        self._realtime = realtime
        self._world: World | None = None

    def open(self) -> None:
        """Build the world and put the robot at its start.

        Raises
        ------
        InputError
            The scene or renderer cannot be used, or the start or the target is not free.
        """
        scene = load_scene(self._options.scene)
        scene.check_clear(self._start, self._mount.forward_m, self.robot, "start")
        scene.check_clear(_TARGET, self._mount.forward_m, self.robot, "target")
        self._world = self._build(scene)
        self._world.put(self._start)
        clock: Clock = WallClock(self._world) if self._realtime else SteppedClock(self._world)
        rng = np.random.default_rng([self._seed, 2])
        capture = FaultyCapture(self._options.faults, rng)
        self.clock = clock
        self.camera = SimCamera(self._model, self._world, clock, capture)
        self.base = SimBase(self._world, clock, self._options)

    def close(self) -> None:
        """See `Backend.close`."""
        if self._world is None:
            return
        try:
            self.base.stop()
        except (LinkError, AttributeError):
            # Nothing to stop: the link is dead on purpose, or opening failed half-way.
            pass
        finally:
            self._world.close()
            self._world = None

    def teach(self, count: int = 1) -> list[Frame]:
        """See `Backend.teach`. The frames differ in their noise."""
        world = self._opened()
        world.put(_TARGET)
        frames = [world.photograph(self.clock.now()) for _ in range(count)]
        world.put(self._start)
        world.skip(self.clock.now())
        return frames

    def truth(self) -> Pose | None:
        """See `Backend.truth`."""
        return self._world.camera_pose() if self._world is not None else None

    def collisions(self) -> int:
        """See `Backend.collisions`."""
        return self._world.physics.contacts if self._world is not None else 0

    def _build(self, scene: Scene) -> World:
        options = self._options
        model = self._true_model
        if (model.width, model.height) != (self._model.width, self._model.height):
            raise CameraError("the true camera's images have another size than the calibration's")
        physics = Physics(scene, self.robot, options.gui)
        try:
            renderer = BulletRenderer(
                scene, model, choose_drawer(options.renderer), options.detail, options.show_floor
            )
        except BaseException:
            physics.close()
            raise
        sensor = Sensor(
            model.width,
            model.height,
            options.image_noise,
            options.blur_px,
            options.exposure,
            self._seed,
        )
        actuation = Actuation(self._limits, options.actuation)
        return World(physics, renderer, sensor, actuation, options, self._mount)

    def _opened(self) -> World:
        if self._world is None:
            raise RuntimeError("the backend is not open")
        return self._world
