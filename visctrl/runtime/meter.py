"""What the summary of a run is made of, in memory that does not grow with the run."""

from __future__ import annotations

import math
from array import array
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.types import Pose
from visctrl.runtime.consistency import ConsistencyMeter
from visctrl.runtime.records import COMPUTE, STAGES, Observer, TickRecord

#: Parts of a tick whose duration is known when it is recorded.
PARTS = STAGES[:-1]
#: What a tick is kept as: features are NaN but in the main stage, compute is what plugins took.
_COLUMNS = ("lateness", "features", *PARTS, "compute")
_RECORDED = len(_COLUMNS) - 1
_COMPUTE = [_COLUMNS.index(name) for name in COMPUTE]
#: Ticks collected before they are sorted in, and ticks kept at most: a quarter of an hour.
_RECENT, _KEPT = 1024, 8192
_MS = 1000.0


class Meter(Observer):
    """Collects what the summary is made of.

    Of a run longer than `_KEPT` ticks every second one is kept, then every fourth and so on, for
    medians and percentiles. Extremes are of all ticks.
    """

    #: But for what `Consistency` says, which is always there.
    reads_signals: ClassVar[bool] = False

    def __init__(self) -> None:
        self.consistency = ConsistencyMeter()
        self.path_length = 0.0
        self.last: TickRecord | None = None
        #: Ticks of the main stage.
        self.main_ticks = 0
        self._recent = array("d")
        self._kept = np.empty((0, len(_COLUMNS)))
        self._every = 1
        self._greatest = np.full(len(_COLUMNS), -math.inf)
        self._fewest = math.inf
        self._position: tuple[float, float] | None = None

    def on_tick(self, record: TickRecord) -> None:
        """Take a tick into account."""
        features = math.nan
        if record.stage == "main":
            features = len(record.views)
            self.main_ticks += 1
        self._recent.extend((record.tick.lateness, features, *record.seconds))
        if len(self._recent) == _RECENT * _RECORDED:
            self._sort_in()
        self.consistency.on_tick(record)
        self.move_to(record.truth or record.odometry.pose)
        self.last = record

    def move_to(self, pose: Pose) -> None:
        """Lengthen the path by the way to ``pose``."""
        here = (pose.x, pose.y)
        if self._position is not None:
            self.path_length += math.dist(here, self._position)
        self._position = here

    def features(self) -> dict[str, int | float | None]:
        """Return the least and the median number of features in the main stage."""
        if self.main_ticks == 0:
            return {"min": None, "median": None}
        numbers = self._column("features")
        return {"min": int(self._fewest), "median": float(np.median(numbers))}

    def spread_ms(self, name: str) -> dict[str, float | None]:
        """Return median, 99th percentile and maximum in ms; None without any tick.

        name : ``lateness``, one of `PARTS`, or ``compute``, which is what the plugins took.
        """
        seconds = np.sort(self._column(name))
        if not len(seconds):
            return {"median": None, "p99": None, "max": None}
        last = len(seconds) - 1
        # A tenth of what `numpy.percentile` takes.
        found = np.interp((0.5 * last, 0.99 * last), np.arange(len(seconds)), seconds).tolist()
        greatest = float(self._greatest[_COLUMNS.index(name)])
        return {
            key: _MS * value
            for key, value in zip(("median", "p99", "max"), (*found, greatest), strict=True)
        }

    def _column(self, name: str) -> NDArray[np.float64]:
        self._sort_in()
        values = self._kept[:, _COLUMNS.index(name)]
        return np.asarray(values[~np.isnan(values)])

    def _sort_in(self) -> None:
        """Put the recent ticks to those that are kept."""
        if not len(self._recent):
            return
        recent = np.array(self._recent).reshape(-1, _RECORDED)
        recent = np.column_stack([recent, recent[:, _COMPUTE].sum(axis=1)])
        self._recent = array("d")
        self._greatest = np.fmax(self._greatest, np.fmax.reduce(recent))
        features = recent[:, _COLUMNS.index("features")]
        self._fewest = min(self._fewest, float(np.fmin.reduce(features, initial=math.inf)))
        self._kept = np.vstack([self._kept, recent[:: self._every]])
        if len(self._kept) > _KEPT:
            self._kept = self._kept[::2].copy()
            self._every *= 2
