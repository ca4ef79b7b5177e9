"""The real robot: driver, camera and wall clock as a backend."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from visctrl.hal.cameras.capture import CaptureCamera, CaptureOptions
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.clock import WallClock
from visctrl.hal.errors import InputError
from visctrl.hal.interfaces import Backend
from visctrl.hal.pioneer.base import PioneerBase
from visctrl.hal.pioneer.handshake import BAUDS
from visctrl.hal.pioneer.subclasses import ring_of
from visctrl.hal.types import Pose
from visctrl.robots import Limits, Robot
from visctrl.robots.documents import StrictModel
from visctrl.robots.model import Mount


class PioneerOptions(StrictModel):
    """Where robot and camera are connected.

    port : device (``/dev/ttyUSB0``, ``COM3``) or URL (``socket://host:8101``) of the robot.
    baud : rate of the line; searched for if left out.
    sonar : whether the sonar rings are switched on.
    camera : the camera's source and settings.
    """

    port: str = "/dev/ttyUSB0"
    baud: Annotated[int, Field(ge=1200, le=4_000_000)] | None = None
    sonar: bool = True
    camera: CaptureOptions = CaptureOptions()


class PioneerBackend(Backend):
    """A Pioneer P3-DX or P3-AT, or its emulator.

    Parameters
    ----------
    robot, mount : Robot, Mount
        Which robot, and where its camera sits.
    camera, true_camera : CentralCamera
        The calibration; both must be the same, for a real camera is what it is.
    start, seed, realtime
        Taken by all backends; here the robot stands where it stands, on the wall clock.
    limits : Limits or None
        Bounds of speed and acceleration; the robot's own operating limits if None.
    options : PioneerOptions
        Port and camera.
    """

    Options: ClassVar[type[PioneerOptions]] = PioneerOptions

    def __init__(
        self,
        robot: Robot,
        camera: CentralCamera,
        true_camera: CentralCamera,
        mount: Mount,
        start: Pose,
        limits: Limits | None,
        options: PioneerOptions,
        seed: int,
        realtime: bool,
    ) -> None:
        del mount, start, seed, realtime
        if true_camera != camera:
            raise InputError(
                "camera_error: only a simulated camera can differ from its calibration"
            )
        self.robot = robot
        self.clock = WallClock()
        bauds = BAUDS if options.baud is None else (options.baud,)
        self.base = PioneerBase(
            options.port, robot.name, limits or robot.operating, self.clock, bauds,
            sonar=options.sonar,
        )  # fmt: skip
        self.camera = CaptureCamera(camera, options.camera, self.clock)

    @classmethod
    def measures_ranges(cls, robot: Robot, options: StrictModel) -> bool:
        """See `Backend.measures_ranges`: the sonar rings, unless they are switched off."""
        return isinstance(options, PioneerOptions) and options.sonar and bool(ring_of(robot.name))

    def open(self) -> None:
        """Open the camera, then the robot, so that nothing can move without being seen.

        Raises
        ------
        CameraError, LinkError, BaseFaultError, InputError
            A device is missing, silent, or not the one that is expected.
        """
        self.camera.open()
        self.base.open()

    def close(self) -> None:
        """Stop the robot and release both devices."""
        try:
            self.base.close()
        finally:
            self.camera.close()

    # Narrower than the interface: what this backend really has.
    clock: WallClock
    base: PioneerBase
    camera: CaptureCamera
