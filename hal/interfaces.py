"""What a backend offers: a camera, a base, a clock.

Each of the three is a small abstract class. A new robot is a new `Backend`; nothing above the
hardware layer knows which one is running.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, ClassVar, Generic, Self, TypeVar

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import BaseStatus, Frame, Odometry, Pose, Range, Velocity
from visctrl.robots import Limits, Robot
from visctrl.robots.documents import StrictModel
from visctrl.robots.model import Mount

_NOTHING_TO_REPORT = BaseStatus()


class Clock(ABC):
    """Steady time in seconds. Simulated clocks advance their world while they "sleep"."""

    #: True where time stands still between two ``sleep_until`` calls (a stepped simulation).
    lockstep: bool = False

    @abstractmethod
    def now(self) -> float:
        """Return the time (s); it never goes back."""

    @abstractmethod
    def sleep_until(self, deadline: float) -> None:
        """Return at ``deadline`` (s), or at once if it has passed."""


class Camera(ABC):
    """A calibrated central camera on the robot."""

    def __init__(self, model: CentralCamera) -> None:
        self.model = model

    @abstractmethod
    def read(self) -> Frame:
        """Return the newest frame without waiting for the next one.

        Raises
        ------
        CameraError
            There is none, or it is not what the calibration says.
        StaleFrameError
            The newest one is older than the camera's age limit.
        """


class Base(ABC):
    """A mobile base that takes (v, ω)."""

    #: Whether it takes whole mm/s and deg/s only; a `Limiter` then carries the remainders.
    whole_units: bool = False

    @abstractmethod
    def command(self, velocity: Velocity) -> Velocity:
        """Set the velocity and return what was really sent, after limits and quantisation.

        Raises
        ------
        LinkError
            The base cannot be reached.
        """

    @abstractmethod
    def odometry(self) -> Odometry:
        """Return the newest odometry."""

    def status(self) -> BaseStatus:
        """Return the base's health; the default is a base that has nothing to report."""
        return _NOTHING_TO_REPORT

    def ranges(self) -> Sequence[Range]:
        """Return the newest reading of every range sensor; the default has none."""
        return ()

    def stop(self) -> None:
        """Bring the base to a standstill as fast as it safely can. May be called at any time."""
        self.command(Velocity(0.0, 0.0))


class BackendOptions(StrictModel):
    """A backend's own section of a scenario.

    flags : the options of the command line that this backend understands, and the key that each
        sets, for example ``{"--port": "port"}``; all others it refuses.
    """

    flags: ClassVar[Mapping[str, str]] = {}


OptionsT = TypeVar("OptionsT", bound=BackendOptions)


@dataclass(frozen=True)
class BackendSetup(Generic[OptionsT]):
    """What a backend is built from: all that a scenario says about robot, camera and world.

    robot, mount : which robot, and where its camera sits.
    camera : the calibration that the robot believes in.
    true_camera : what simulated frames are made with; hardware can only refuse another one.
    start : pose of the camera in the target's frame, where a simulated robot begins; hardware
        stands where it stands.
    limits : bounds of speed and acceleration; None for a base without any.
    options : the backend's own, checked.
    seed : of every random draw of a simulation.
    realtime : whether a simulated clock follows the wall clock instead of the caller's ticks.
    """

    robot: Robot
    mount: Mount
    camera: CentralCamera
    true_camera: CentralCamera
    start: Pose
    limits: Limits | None
    options: OptionsT
    seed: int = 0
    realtime: bool = False


class Backend(ABC):
    """A robot with its camera and clock, opened as a context manager.

    Leaving the context stops the base and releases every device, whatever happened. Building
    one touches nothing: devices are opened, and worlds made, in `open`.

    Parameters
    ----------
    setup : BackendSetup
        What to build it from.
    """

    #: What its section of a scenario may hold.
    Options: ClassVar[type[BackendOptions]]
    #: Whether frames carry identified features; else they carry images.
    delivers_features: ClassVar[bool] = False

    camera: Camera
    base: Base
    clock: Clock

    def __init__(self, setup: BackendSetup[Any]) -> None:
        self.setup = setup

    @property
    def robot(self) -> Robot:
        """The robot that it drives."""
        return self.setup.robot

    @classmethod
    def measures_ranges(cls, robot: Robot, options: Any) -> bool:
        """Return whether the base would have range sensors; the default has none."""
        del robot, options
        return False

    @classmethod
    def kept_limits(cls, limits: Limits, options: Any) -> Limits | None:
        """Return the bounds that the base keeps; the default keeps those that it is given."""
        del options
        return limits

    @abstractmethod
    def open(self) -> None:
        """Connect to the devices (or build the world).

        Raises
        ------
        DeviceError, InputError
            A device is missing; the scenario cannot be set up. Nothing is left open.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop the base and release the devices. Safe to call twice, and after a failed open."""

    def teach(self, count: int = 1) -> list[Frame]:
        """Return ``count`` frames taken at the target pose, by visiting it.

        Only simulated robots can do this; hardware returns an empty list and needs a target
        file. Afterwards the robot stands at its start.
        """
        del count
        return []

    def truth(self) -> Pose | None:
        """Return the camera's true pose in the target's frame where it is known.

        For evaluation only: no plugin ever sees it.
        """
        return None

    def collisions(self) -> int:
        """Return how many contacts with anything but the floor there have been since opening."""
        return 0

    def __enter__(self) -> Self:
        try:
            self.open()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
