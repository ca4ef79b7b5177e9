"""What is known of one tick after it: for the recorder, the report and whoever watches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple, Protocol

from visctrl.contracts import Decision, Estimate, Match, Views
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Frame, Odometry, Pose, Velocity
from visctrl.robots import Robot
from visctrl.robots.model import Mount
from visctrl.runtime.config import Scenario
from visctrl.runtime.scheduler import Tick

#: The parts of a tick, in order. ``record`` is the cost of handing the tick to its watchers.
STAGES = ("frame", "perception", "estimation", "control", "command", "record")
#: The parts that plugins do.
COMPUTE = ("perception", "estimation", "control")


class Setup(Protocol):
    """What is known before the first tick: a `Plan` is one."""

    @property
    def scenario(self) -> Scenario:
        """What was asked for."""

    @property
    def robot(self) -> Robot:
        """Which robot."""

    @property
    def mount(self) -> Mount:
        """Where it carries its camera."""

    @property
    def camera(self) -> CentralCamera:
        """The camera's calibration."""


class TickRecord(NamedTuple):
    """One tick.

    number : ticks since the run began, approach included.
    t : time since the run's first tick (s).
    stage : ``approach`` or ``main``.
    truth : true pose of the camera in the target's frame, None where unknown.
    event : what safety did, empty if nothing.
    blame : part of the previous tick that made this one miss deadlines, empty if none.
    signals : every plugin's own numbers, by plugin name, where an observer reads them.
    seconds : duration of the parts in `STAGES`; the last is not known yet and left out.
    """

    number: int
    t: float
    stage: str
    tick: Tick
    frame: Frame
    views: Views
    estimate: Estimate
    decision: Decision
    sent: Velocity
    odometry: Odometry
    truth: Pose | None
    battery_v: float | None
    event: str
    blame: str
    signals: tuple[tuple[str, Mapping[str, float]], ...]
    seconds: tuple[float, ...]


class Observer:
    """Watches a run. Every method is called between ticks and must not block.

    The default is to ignore everything.
    """

    #: Whether it reads `TickRecord.signals`: what nobody reads is not collected.
    reads_signals: ClassVar[bool] = True

    def on_message(self, text: str) -> None:
        """Hear that something begins which takes a while."""

    def on_target(self, frames: Sequence[Frame]) -> None:
        """Get the target view: one frame, or several of one pose."""

    def on_initial(self, frame: Frame, match: Match) -> None:
        """Get an initial view once it is matched."""

    def on_begin(self, *, lockstep: bool) -> None:
        """Hear that the first tick comes next.

        Parameters
        ----------
        lockstep : bool
            Time stands still during a tick: the run may be kept waiting.

        Raises
        ------
        InputError
            What was asked of this observer cannot be done; the run does not begin.
        """

    def on_stage(self, stage: str) -> None:
        """Hear that a stage begins."""

    def on_tick(self, record: TickRecord) -> None:
        """Get a tick whose command is sent."""

    def on_end(self) -> Sequence[str]:
        """Hear that the run's files are written; return what the user should know besides."""
        return ()

    def close(self) -> None:
        """Let go of everything: the run has ended, or it never began. May be called twice."""
