"""What a ring of sonars tells of the floor around the robot: a probabilistic occupancy grid.

A reading says two things (Moravec and Elfes, *High resolution maps from wide angle sonar*, 1985):
nothing in the cone is nearer than its range, and something on the arc at its range has echoed.
The first is sure and frees cells; the second leaves open which cell it was. As in forward models
(Thrun, *Learning occupancy grid maps with forward sensor models*, 2003) an echo needs only one
cause: each cell of the arc is believed in proportion to what is already known of it. So an arc
shrinks to what no other reading has found free; and where all of it was free before, something
new has come, and all of it counts.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Side of a cell (m).
CELL_M = 0.05
#: Log odds that a reading takes from a cell it finds free, and that an echo from one of ten
#: equally likely cells gives to each.
_FREE, _ECHO_OF_TEN = 0.8, 0.5
#: Bounds of the log odds: what is free must be able to become occupied within a second.
_LEAST, _MOST = -2.0, 3.0
#: Log odds from which a cell counts as occupied.
_OCCUPIED = 0.8
#: An echo's range is right to within this (m).
_NEARER_M, _FARTHER_M = 0.04, 0.08
#: Share of the cone in which most of the sound goes, and what all that is said of a cell counts
#: at the cone's edge.
_SURE, _EDGE = 0.85, 0.25
#: The map follows a robot that is farther than this from its middle (m).
_OFF_CENTRE_M = 0.8


class Reading(NamedTuple):
    """One reading: where its sensor was (m), the direction it looked in, and what it said.

    heading : counter-clockwise from the y axis (rad). distance : may be infinite (m).
    """

    x: float
    y: float
    heading: float
    distance: float


class EchoMap:
    """Log odds of cells about the robot, in a fixed frame; what it leaves behind is forgotten.

    Parameters
    ----------
    reach : float
        Readings are believed up to this distance (m).
    cone : float
        Full opening of a sensor's cone (rad).
    """

    def __init__(self, reach: float, cone: float) -> None:
        self._reach = reach
        self._cone = cone
        self._count = 2 * math.ceil((reach + 1.5 + _OFF_CENTRE_M) / CELL_M)
        self.odds = np.zeros((self._count, self._count))
        self._first = (-self._count // 2, -self._count // 2)
        self._cells = np.arange(self._count) + 0.5

    def follow(self, x: float, y: float) -> None:
        """Keep the robot, at (x, y) in m, near the middle."""
        shift = []
        for first, here in zip(self._first, (x, y), strict=True):
            off = here - (first + self._count / 2) * CELL_M
            shift.append(round(off / CELL_M) if abs(off) > _OFF_CENTRE_M else 0)
        if any(shift):
            moved = np.zeros_like(self.odds)
            new = tuple(slice(max(-k, 0), self._count - max(k, 0)) for k in shift)
            old = tuple(slice(max(k, 0), self._count - max(-k, 0)) for k in shift)
            moved[new] = self.odds[old]
            self.odds = moved
            self._first = (self._first[0] + shift[0], self._first[1] + shift[1])

    def forget(self, share: float) -> None:
        """Let everything that is known fade by a share."""
        self.odds *= 1.0 - share

    def take(self, readings: list[Reading]) -> None:
        """Take readings into account that were made at the same time."""
        change = np.zeros_like(self.odds)
        for reading in readings:
            self._take(reading, change)
        self.odds += change
        np.clip(self.odds, _LEAST, _MOST, out=self.odds)

    def free(self, x: float, y: float, radius: float) -> None:
        """Note that nothing stands within ``radius`` of a place: the robot does (m)."""
        rows, columns, dx, dy = self._window(x, y, radius)
        part = self.odds[rows, columns]
        part[dx**2 + dy**2 <= radius**2] = _LEAST

    def occupied(self) -> Array:
        """Return the middles (K, 2) of the cells that are occupied (m)."""
        cells = np.argwhere(self.odds >= _OCCUPIED)
        return np.asarray((cells + np.array(self._first) + 0.5) * CELL_M, dtype=np.float64)

    def _take(self, reading: Reading, change: Array) -> None:
        echoed = reading.distance < self._reach
        # What does not echo within reach frees as far as what does may be believed.
        span = min(reading.distance, self._reach + _NEARER_M + _FARTHER_M)
        rows, columns, dx, dy = self._window(reading.x, reading.y, span + _FARTHER_M)
        ahead = -math.sin(reading.heading) * dx + math.cos(reading.heading) * dy
        away = np.sqrt(dx**2 + dy**2)
        part = change[rows, columns]
        cone = ahead >= math.cos(self._cone / 2.0) * away
        sure = ahead >= math.cos(_SURE * self._cone / 2.0) * away
        before = away < span - _NEARER_M
        part[cone & before] -= _EDGE * _FREE
        part[sure & before] -= (1.0 - _EDGE) * _FREE
        if not echoed:
            return
        arc = cone & ~before & (away <= span + _FARTHER_M)
        if arc.any():
            known = 1.0 / (1.0 + np.exp(-self.odds[rows, columns][arc]))
            known *= np.where(sure[arc], 1.0, _EDGE)
            likely = max(self._cone * span / CELL_M, 2.0)
            part[arc] += 10.0 * _ECHO_OF_TEN / likely * known / known.max()

    def _window(self, x: float, y: float, radius: float) -> tuple[slice, slice, Array, Array]:
        """Return the rows and columns within ``radius`` of a place, and their places from it."""
        bounds: list[slice] = []
        away: list[Array] = []
        for first, here in zip(self._first, (x, y), strict=True):
            low = math.floor((here - radius) / CELL_M) - first
            high = math.ceil((here + radius) / CELL_M) - first
            bound = slice(min(max(low, 0), self._count), min(max(high, 0), self._count))
            bounds.append(bound)
            middles = (self._cells[bound] + first) * CELL_M - here
            away.append(middles.astype(np.float64, copy=False))
        return bounds[0], bounds[1], away[0][:, None], away[1][None, :]
