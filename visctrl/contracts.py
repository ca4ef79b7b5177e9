"""The contracts between perception, estimation and control, and what passes between them.

One tick: ``frame → Perception → Views → Estimator → Estimate → Controller → Decision``; where
the scenario names obstacle providers, ``Estimate → ObstacleProvider → Obstacle``s for the
controller, too. A plugin is a class with a pydantic ``Options`` model; it is built as
``Plugin(options, context)``. It sees frames, the calibration, range readings and what was sent
to the base; never the truth.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import STANDSTILL, Frame, Range, Velocity
from visctrl.robots import Limits
from visctrl.robots.documents import StrictModel
from visctrl.robots.model import Body

Array = NDArray[np.float64]


class Health(StrEnum):
    """Whether a result may be used."""

    OK = "ok"
    #: Measured, but the geometry does not determine it: hold, or use another pair of views.
    DEGENERATE = "degenerate"
    #: Nothing was measured: the robot must stop.
    LOST = "lost"


@dataclass(frozen=True)
class Context:
    """What every plugin is told when it is built.

    camera : the calibration that the robot believes in.
    limits : bounds of what the base will execute; None for an ideal robot.
    camera_forward_m : ℓ, the camera ahead of the axle (m).
    period_s : nominal tick (s).
    seed : for every random choice a plugin makes.
    lockstep : time stands still during a tick, so results must not depend on how long work
        takes; on a wall clock, late background work may simply arrive later.
    body : outline of the robot, about the axle's centre; None for a point.
    """

    camera: CentralCamera
    limits: Limits | None
    camera_forward_m: float
    period_s: float
    seed: int
    lockstep: bool
    body: Body | None = None

    def slowdown(self, wanted: Velocity) -> float:
        """Return the factor ≤ 1 by which the speed limits will scale a wish, path and all.

        Who follows a reference in time lets that pass the slower.
        """
        return 1.0 if self.limits is None else 1.0 / max(1.0, self.limits.ratio(*wanted))


@dataclass(frozen=True)
class Views:
    """The same features seen from the target, the initial and the current pose.

    target, initial, current : (N, 3) unit rays (right, forward, up) in the robot's frame at
        that pose.
    pixels : (N, 2) image points in the current frame, for drawing.
    ids : (N,) names of the features, stable over time.
    sigma : standard deviation of one bearing (rad), the same for all.
    stamp : exposure time of the current frame (s).
    sigmas : returns the standard deviations (3, N) of each bearing in the target, initial and
        current view (rad), where they are known one by one: rays near the rim of an image are
        sharper, a target averaged over several frames is better than one frame, and a landmark
        on which the fixed views disagree is less certain. Few estimators ask. None: ``sigma``
        for all.
    """

    ids: NDArray[np.int64]
    target: Array
    initial: Array
    current: Array
    pixels: Array
    sigma: float
    stamp: float
    health: Health = Health.OK
    reason: str = ""
    sigmas: Callable[[], Array] | None = None

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def nothing(cls, stamp: float, reason: str) -> Views:
        """Return the views of a frame that must not be used, exposed at ``stamp`` (s)."""
        ids, rays = np.empty(0, dtype=np.int64), np.empty((0, 3))
        return cls(ids, rays, rays, rays, rays[:, :2], 0.0, stamp, Health.LOST, reason)

    def bearing_sigmas(self) -> Array:
        """Return the standard deviations (3, N) of the bearings: target, initial, current."""
        if self.sigmas is not None:
            return self.sigmas()
        return np.full((3, len(self)), self.sigma)


class MatchedMotion(NamedTuple):
    """Where the initial view was taken, in the target's frame, up to the distance (rad).

    phi : heading, counter-clockwise. direction : bearing of its place, clockwise from forward.
    phi_sd, direction_sd : their standard deviations.
    """

    phi: float
    direction: float
    phi_sd: float
    direction_sd: float


@dataclass(frozen=True)
class Match:
    """How the target and initial views were matched.

    candidates : descriptor matches before the geometric check; inliers : after it.
    target_pixels, initial_pixels : (inliers, 2) image points, for drawing.
    motion : what matching found; None where it did not look for any.
    """

    candidates: int
    inliers: int
    target_pixels: Array
    initial_pixels: Array
    motion: MatchedMotion | None = None


@dataclass(frozen=True)
class Signal:
    """A number that a plugin reports every tick; it becomes a column of ``ticks.csv``."""

    name: str
    unit: str


@dataclass(frozen=True)
class Estimate:
    """What an estimator found. Subclasses add the quantities and their covariance."""

    health: Health
    reason: str = ""


class Obstacle(NamedTuple):
    """A disc on the floor that the robot must not touch, as seen from the camera.

    right, forward : its centre (m).
    radius : (m).
    certain : False for what may turn out smaller, or not to be there, when looked at from
        elsewhere.
    """

    right: float
    forward: float
    radius: float
    certain: bool = True


class Decision(NamedTuple):
    """What a controller wants.

    phase : name of the part of its task that it is in.
    finished : its own termination test holds; the run ends here.
    """

    velocity: Velocity = STANDSTILL
    phase: str = ""
    finished: bool = False


OptionsT = TypeVar("OptionsT", bound=StrictModel)
EstimateT = TypeVar("EstimateT", bound=Estimate)


class Plugin(ABC, Generic[OptionsT]):
    """Common part of all plugins."""

    Options: ClassVar[type[StrictModel]]
    #: Columns that `values` fills.
    signals: ClassVar[tuple[Signal, ...]] = ()

    def __init__(self, options: OptionsT, context: Context) -> None:
        self.options = options
        self.context = context

    def values(self) -> Mapping[str, float]:
        """Return this tick's numbers by the names in ``signals``; absent ones stay empty."""
        return {}

    def notes(self) -> Sequence[str]:
        """Return what the user should know when the run is over, a sentence each."""
        return ()

    def close(self) -> None:
        """Release what the plugin holds (threads, files)."""


class Perception(Plugin[OptionsT]):
    """Turns frames into features seen in three views."""

    @abstractmethod
    def set_target(self, frames: Sequence[Frame]) -> None:
        """Take the target view: one frame, or several of the same pose to average.

        Raises
        ------
        InputError
            The image cannot serve as a target (blank, wrong size, too few features).
        """

    @abstractmethod
    def set_initial(self, frame: Frame) -> Match:
        """Take the initial view and match it to the target. May take longer than a tick.

        It may be called again later, from another pose: tracking starts anew there.

        Raises
        ------
        InputError
            The target is not recognised from here; the message says how many features agree
            and how many are needed.
        """

    @abstractmethod
    def update(self, frame: Frame) -> Views:
        """Return the features of ``frame``. Never raises for what the image shows: see health."""


class Estimator(Plugin[OptionsT], Generic[OptionsT, EstimateT]):
    """Turns views into geometry."""

    @abstractmethod
    def reset(self) -> None:
        """Forget everything: a new initial view has been taken here."""

    @abstractmethod
    def update(self, views: Views, sent: Velocity, dt: float) -> EstimateT:
        """Return the geometry of the three views.

        sent : what the base was last told, which acted during the ``dt`` seconds before the
        frame.
        """


class ObstacleProvider(Plugin[OptionsT], Generic[OptionsT, EstimateT]):
    """Knows what stands in the robot's way."""

    #: Estimates that `update` accepts, checked when a run is put together.
    accepts: ClassVar[type[Estimate]]
    #: Whether it needs the base's range sensors; a backend without any is then refused.
    listens: ClassVar[bool] = False

    @abstractmethod
    def update(
        self, estimate: EstimateT, ranges: Sequence[Range], now: float
    ) -> Sequence[Obstacle]:
        """Return all obstacles that the robot must mind now, where they are seen from now.

        Called in every tick whose estimate is not lost, those before the pose is known
        included.

        ranges : what the range sensors say now; empty for one that does not listen.
        now : the time on a steady clock (s).
        """

    def expected(self) -> Sequence[Obstacle]:
        """Return what it will certainly report one day, as seen from the target.

        Nothing avoids these before `update` reports them; a task that ends in one is refused
        before anything moves.
        """
        return ()


class Controller(Plugin[OptionsT], Generic[OptionsT, EstimateT]):
    """Turns geometry into a velocity.

    It wants what its law wants. Bounds, ramps and rounding come after it (`hal.actuation`), and
    `Context.slowdown` tells beforehand what the speed limits leave of a wish.
    """

    #: Estimates that `update` accepts, checked when a scheme is put together.
    accepts: ClassVar[type[Estimate]]
    #: Whether it heeds `sense`; one that does not is refused where there are obstacles.
    avoids: ClassVar[bool] = False

    def expect(self, obstacles: Sequence[Obstacle]) -> None:
        """Check that the task can be done with obstacles that will be met, seen from the target.

        Raises
        ------
        InputError
            It cannot; the message says why.
        """

    def sense(self, obstacles: Sequence[Obstacle]) -> None:
        """Hear of all present obstacles, before `update`; only where there are providers."""

    @abstractmethod
    def update(self, estimate: EstimateT, sent: Velocity, dt: float) -> Decision:
        """Return the velocity for an estimate.

        It is not asked while nothing is seen: the robot is then held, and its time stands still.

        sent : what the base was told for the last decision.
        dt : how long that has acted (s); 0 the first time.
        """
