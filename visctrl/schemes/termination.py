"""The end of a drive: there, by the robot's own measurements, or beside the target."""

from __future__ import annotations

import math
from collections import deque
from enum import Enum
from typing import Annotated

from pydantic import Field

from visctrl.hal.types import Velocity
from visctrl.robots.documents import StrictModel

#: The robot stands when it is told to move slower than this (m/s, rad/s).
STANDING = Velocity(0.006, math.radians(1.5))
#: Within tolerance, it waits this long for the rest of the error to go (s).
PATIENCE_S = 3.0

Positive = Annotated[float, Field(gt=0.0)]


class ArrivalOptions(StrictModel):
    """What counts as arrived, by the robot's own measurement.

    tolerance_m, tolerance_deg : of each coordinate of the position, and of the heading.
    steady_ticks : over how many ticks at a standstill that is averaged.
    retreats : how often to back up and come again when the lateral error stays too large.
    retreat_m : how far back at least.
    """

    tolerance_m: Positive = 0.01
    tolerance_deg: Positive = 0.3
    steady_ticks: Annotated[int, Field(ge=2)] = 8
    retreats: Annotated[int, Field(ge=0, le=10)] = 2
    retreat_m: Positive = 0.4


class Verdict(Enum):
    """How things stand: nothing settled yet, arrived, or settled with a lateral error."""

    UNDER_WAY = "under way"
    THERE = "there"
    BESIDE = "beside"


class Arrival:
    """Watches a robot that settles on its target and decides when that is over.

    Forward error and heading can still be closed on the spot, so it waits until they are within
    tolerance and then until the measurement shows none (or `PATIENCE_S`). A lateral error
    cannot: the robot has to back up and come again, as often as the options allow.
    """

    def __init__(self, options: ArrivalOptions) -> None:
        self._options = options
        #: How often the robot has been told to come again.
        self.retreats = 0
        self._lateral = 0.0
        self.restart()

    def restart(self) -> None:
        """Begin to watch: the robot comes (again)."""
        self._recent: deque[tuple[float, float, float]] = deque(maxlen=self._options.steady_ticks)
        self._waited = 0.0

    def has_room(self, forward_m: float) -> bool:
        """Return whether a robot that backs up is far enough from the target to come again.

        It is where the way back is not too steep for the lateral error to close.
        """
        least = self._options.retreat_m
        return forward_m >= min(max(least, 6.0 * abs(self._lateral)), 3.0 * least)

    def judge(
        self, position: tuple[float, float], heading: float, sent: Velocity, dt: float
    ) -> Verdict:
        """Return the verdict after one more tick.

        position : the target, (right, forward) of the robot (m).
        heading : of the robot in the target's frame (rad).
        sent : what the robot was told last; dt : for how long (s).

        After `Verdict.BESIDE` it is to back up until it `has_room`.
        """
        if abs(sent.v) > STANDING.v or abs(sent.omega) > STANDING.omega:
            self._recent.clear()
        self._recent.append((*position, heading))
        if len(self._recent) < self._options.steady_ticks:
            return Verdict.UNDER_WAY
        columns = list(zip(*self._recent, strict=True))
        right, forward, turn = (math.fsum(column) / len(column) for column in columns)
        closing = (
            (forward, self._options.tolerance_m, columns[1]),
            (turn, math.radians(self._options.tolerance_deg), columns[2]),
        )
        if any(abs(mean) > tolerance for mean, tolerance, _ in closing):
            self._waited = 0.0
            return Verdict.UNDER_WAY
        self._waited += dt
        settled = all(abs(each[0]) <= _floor(*each) for each in closing)
        if not settled and self._waited < PATIENCE_S:
            return Verdict.UNDER_WAY
        self._lateral = right
        if abs(right) <= self._options.tolerance_m:
            return Verdict.THERE
        if self.retreats >= self._options.retreats:
            return Verdict.UNDER_WAY
        self.retreats += 1
        return Verdict.BESIDE


class Divergence:
    """Whether a robot has got much farther from its target than it began.

    No law does that on purpose: what it measures or is told must be far from the truth.

    Parameters
    ----------
    factor, leeway_m : float
        So many times the first distance, and so much farther, is too far.
    """

    def __init__(self, factor: float, leeway_m: float) -> None:
        self._factor, self._leeway_m = factor, leeway_m
        self._first: float | None = None

    def begin(self, distance: float) -> None:
        """Take a distance, in any unit, as the first one."""
        self._first = distance

    @property
    def begun(self) -> bool:
        """Whether there is a first distance."""
        return self._first is not None

    def astray(self, distance: float, unit_m: float = 1.0) -> bool:
        """Return whether a distance is too far; ``unit_m`` is its unit as known now (m)."""
        if self._first is None:
            return False
        return distance > self._factor * self._first + self._leeway_m / unit_m


def _floor(mean: float, tolerance: float, column: tuple[float, ...]) -> float:
    """Return the mean below which a column of measurements shows no error any more."""
    count = len(column)
    # `statistics.stdev` computes in fractions, a hundred times as long.
    deviation = math.dist(column, (mean,) * count) / math.sqrt(count - 1)
    return max(tolerance / 10.0, 2.0 * deviation / math.sqrt(count))
