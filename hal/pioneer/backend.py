"""The real robot: driver, camera and wall clock as a backend."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

from pydantic import Field

from visctrl.hal.cameras.capture import CaptureCamera, CaptureOptions
from visctrl.hal.clock import WallClock
from visctrl.hal.errors import InputError
from visctrl.hal.interfaces import Backend, BackendOptions, BackendSetup
from visctrl.hal.pioneer.base import PioneerBase
from visctrl.hal.pioneer.handshake import BAUDS
from visctrl.robots import Robot


class PioneerOptions(BackendOptions):
    """Where robot and camera are connected.

    port : device (``/dev/ttyUSB0``, ``COM3``) or URL (``socket://host:8101``) of the robot.
    baud : rate of the line; searched for if left out.
    sonar : whether the sonar rings are switched on.
    reconnect_s : for how long to begin new sessions after the line has failed; the robot stands
        meanwhile. 0: the run fails at once.
    camera : the camera's source and settings.
    """

    flags: ClassVar[Mapping[str, str]] = {"--port": "port", "--camera-url": "camera.source"}

    port: str = "/dev/ttyUSB0"
    baud: Annotated[int, Field(ge=1200, le=4_000_000)] | None = None
    sonar: bool = True
    reconnect_s: Annotated[float, Field(ge=0.0, le=600.0)] = 0.0
    camera: CaptureOptions = CaptureOptions()


class PioneerBackend(Backend):
    """A Pioneer P3-DX or P3-AT, or its emulator; it stands where it stands, on the wall clock.

    Raises
    ------
    InputError
        The true camera is not the calibration: a real camera is what it is.
    """

    Options: ClassVar[type[PioneerOptions]] = PioneerOptions

    def __init__(self, setup: BackendSetup[PioneerOptions]) -> None:
        super().__init__(setup)
        if setup.true_camera != setup.camera:
            raise InputError(
                "camera_error: only a simulated camera can differ from its calibration"
            )
        options = setup.options
        self.clock = WallClock()
        bauds = BAUDS if options.baud is None else (options.baud,)
        self.base = PioneerBase(
            options.port, setup.robot, setup.limits or setup.robot.operating, self.clock,
            bauds, sonar=options.sonar, reconnect_s=options.reconnect_s,
        )  # fmt: skip
        self.camera = CaptureCamera(setup.camera, options.camera, self.clock)

    @classmethod
    def measures_ranges(cls, robot: Robot, options: PioneerOptions) -> bool:
        """See `Backend.measures_ranges`: the sonar rings, unless they are switched off."""
        return options.sonar and robot.sonar is not None

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
    setup: BackendSetup[PioneerOptions]
    clock: WallClock
    base: PioneerBase
    camera: CaptureCamera
