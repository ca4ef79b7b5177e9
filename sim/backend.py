"""The simulated robot: PyBullet's physics, rendered images, and a clock that steps them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from visctrl.hal.actuation import Actuation
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.clock import WallClock, WorldClock
from visctrl.hal.errors import CameraError, LinkError
from visctrl.hal.faults import FaultyCapture, check_link
from visctrl.hal.interfaces import Backend, BackendSetup, Base, Camera
from visctrl.hal.types import Frame, Odometry, Pose, Range, Velocity
from visctrl.robots import Robot
from visctrl.sim.options import Changes, SimOptions
from visctrl.sim.world.changes import changed
from visctrl.sim.world.eye import open_eye
from visctrl.sim.world.people import Walker, people
from visctrl.sim.world.physics import Physics
from visctrl.sim.world.scene import Item, Scene, load_scene
from visctrl.sim.world.world import World

_TARGET = Pose(0.0, 0.0, 0.0)


class SimCamera(Camera):
    """The simulated camera. A frame is rendered only when it is read."""

    def __init__(
        self, model: CentralCamera, world: World, clock: WorldClock, capture: FaultyCapture
    ) -> None:
        super().__init__(model)
        self._world = world
        self._clock = clock
        self._capture = capture
        self._newest: Frame | None = None
        self._read_at = 0.0

    def read(self) -> Frame:
        """See `Camera.read`. Reading twice at one instant gives one frame."""
        now = self._clock.synchronise()
        if self._newest is None or now > self._read_at:
            self._newest = self._capture.deliver(now, lambda: self._world.photograph(now))
            self._read_at = now
        return self._newest


class SimBase(Base):
    """The simulated base."""

    def __init__(self, world: World, clock: WorldClock, options: SimOptions) -> None:
        self._world = world
        self._clock = clock
        self._faults = options.faults
        self.whole_units = world.actuation.whole_units

    def command(self, velocity: Velocity) -> Velocity:
        """See `Base.command`."""
        if self._world.closed:
            raise LinkError("the simulation has been closed")
        now = self._clock.synchronise()
        check_link(self._faults, now)
        return self._world.actuation.request(now, velocity)

    def odometry(self) -> Odometry:
        """See `Base.odometry`."""
        return self._world.odometry(self._clock.synchronise())

    def ranges(self) -> list[Range]:
        """See `Base.ranges`: rays that stand for the robot's sonar rings."""
        self._clock.synchronise()
        return self._world.ranges()


class SimBackend(Backend):
    """A robot in a PyBullet scene with a rendered camera (see `Backend`).

    The seed is that of image noise, exposure and dropped frames; the scene has its own.
    """

    Options: ClassVar[type[SimOptions]] = SimOptions

    # Narrower than the interface: what this backend really has.
    setup: BackendSetup[SimOptions]
    clock: WorldClock

    def __init__(self, setup: BackendSetup[SimOptions]) -> None:
        super().__init__(setup)
        self._world: World | None = None

    @classmethod
    def measures_ranges(cls, robot: Robot, options: SimOptions) -> bool:
        """See `Backend.measures_ranges`: rays stand for the sonar rings that the robot has."""
        del options
        return robot.sonar is not None

    def open(self) -> None:
        """Build the world and put the robot at its start.

        Raises
        ------
        InputError
            The scene or renderer cannot be used, or the start or the target is not free.
        """
        setup, options = self.setup, self.setup.options
        scene = self.scene()
        walkers = people(scene, options.people, setup.seed)
        scene = changed(scene, options.changes)
        scene = scene.model_copy(update={"items": (*scene.items, *(w.item for w in walkers))})
        scene.check_clear(setup.start, setup.mount.forward_m, self.robot, "start")
        scene.check_clear(_TARGET, setup.mount.forward_m, self.robot, "target")
        self._world = self._build(scene, walkers)
        self._world.put(setup.start)
        clock = WorldClock(self._world.advance, WallClock() if setup.realtime else None)
        rng = np.random.default_rng([setup.seed, 2])
        capture = FaultyCapture(setup.options.faults, rng)
        self.clock = clock
        self.camera = SimCamera(setup.camera, self._world, clock, capture)
        self.base = SimBase(self._world, clock, setup.options)

    def close(self) -> None:
        """See `Backend.close`."""
        if self._world is not None:
            self._world.close()
            self._world = None

    def teach(self, count: int = 1) -> list[Frame]:
        """See `Backend.teach`. The frames differ in their noise; they show the scene unchanged."""
        world, options = self._opened(), self.setup.options
        if options.changes == Changes() and not options.people:
            world.put(_TARGET)
            frames = [world.photograph(self.clock.now()) for _ in range(count)]
            world.put(self.setup.start)
            return frames
        eye = open_eye(self.setup, self.scene(), Changes())
        try:
            return [eye.photograph(self.clock.now(), _TARGET, moving=False) for _ in range(count)]
        finally:
            eye.close()

    def move(self, item: str, at: Pose) -> None:
        """Move an item of the scene to another place (x, y, φ = its yaw), like an obstacle.

        Raises
        ------
        InputError
            The scene has no such item.
        """
        self._opened().move(item, at)

    def truth(self) -> Pose | None:
        """See `Backend.truth`."""
        if self._world is None:
            return None
        self.clock.synchronise()
        return self._world.camera_pose()

    def collisions(self) -> int:
        """See `Backend.collisions`."""
        return self._world.physics.contacts if self._world is not None else 0

    def scene(self) -> Scene:
        """Return the scene as it was when the target's image was taken."""
        scene = load_scene(self.setup.options.scene)
        boxes = [
            Item(
                name=f"box {number}",
                at_m=(box.x_m, box.y_m),
                size_m=(box.width_m, box.depth_m, box.height_m),
                yaw_deg=box.yaw_deg,
            )
            for number, box in enumerate(self.setup.options.boxes, 1)
        ]
        return scene.model_copy(update={"items": (*scene.items, *boxes)})

    def _build(self, scene: Scene, walkers: Sequence[Walker]) -> World:
        setup, options = self.setup, self.setup.options
        model, believed = setup.true_camera, setup.camera
        if (model.width, model.height) != (believed.width, believed.height):
            raise CameraError("the true camera's images have another size than the calibration's")
        physics = Physics(scene, self.robot, options.gui)
        try:
            eye = open_eye(setup, scene, options.changes, walkers)
        except BaseException:
            physics.close()
            raise
        return World(
            physics,
            eye,
            Actuation(setup.limits, options.actuation),
            options.actuation,
            (setup.mount.forward_m + options.mount_error.forward_m, options.mount_error.left_m),
            options.scatter.drawer(np.random.default_rng([setup.seed, 4])),
            walkers,
        )

    def _opened(self) -> World:
        if self._world is None:
            raise RuntimeError("the backend is not open")
        return self._world
