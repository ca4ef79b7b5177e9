"""What stands in the way of a robot's outline, and ways round it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.types import Pose
from visctrl.planning.footprint import Footprint
from visctrl.planning.lattice_planner import Drive, Point, Search
from visctrl.robots.unicycle import step_exact

Array = NDArray[np.float64]

#: What stands nearer than this to the robot at its goal leaves no room for it (m).
_ROOM_M = 0.03
#: Where something is nearer than the margin, it may come nearer by this (m): the circles that
#: cover the outline make its straight sides uneven.
_SLACK_M = 0.025


class WayFinder:
    """Finds ways for one robot.

    Parameters
    ----------
    outline : Footprint
    camera : float
        Camera ahead of the axle (m).
    margin : float
        Distance that the outline keeps from discs (m).
    """

    def __init__(self, outline: Footprint, camera: float, margin: float) -> None:
        self._outline = outline
        self._camera = camera
        self._margin = margin

    def axle(self, pose: Pose) -> Array:
        """Return the axle's pose (3,) for one of the camera."""
        return step_exact(pose, -self._camera, 0.0, 1.0)

    def gaps(self, place: Point, discs: Array) -> Array:
        """Return the gaps (M,) to discs (M, 3) of a robot whose camera stands there, heading 0."""
        return self._outline.gaps(self.axle(Pose(*place, 0.0)), discs)

    def clear(
        self, axle: Array, discs: Array, last: Point | None = None, share: float = 1.0
    ) -> bool:
        """Return whether a share of the margin is kept from discs (M, 3) on a way of the axle.

        Parameters
        ----------
        axle : (P, 3) array
            Poses on the way, the first being where it is now.
        discs : (M, 3) array
        last : (x, y), optional
            Where the camera will stop for good (m), if the way leads there: what stands near it
            leaves no more room than there.
        share : float
        """
        gaps = self._outline.gaps(axle, discs)
        room = self._room(gaps[0], last, discs, share)
        return room is not None and bool((gaps >= room).all())

    def way(
        self,
        pose: Pose,
        goal: Point,
        discs: Array,
        drive: Drive,
        *,
        final: bool,
        retreat: bool,
    ) -> list[Point] | None:
        """Return the intermediate goals of the best clear way; none for a direct one.

        Parameters
        ----------
        pose : Pose
            Of the camera, the robot standing.
        goal : (x, y)
            Of the camera (m).
        discs : (M, 3) array
        drive : Drive
        final : bool
            Whether the robot stops there for good.
        retreat : bool
            Whether it may turn round and drive away from the goal first.

        Returns
        -------
        list of (x, y), or None
            None: no way was found.
        """
        here = self.axle(pose)
        room = self._room(self._outline.gaps(here, discs), goal if final else None, discs, 1.0)
        if room is None:
            return None
        # With its radius smaller, the margin is what each disc can be asked for.
        eased = discs - np.outer(self._margin - room, (0.0, 0.0, 1.0))
        search = Search(self._outline, self._camera, self._margin, eased, drive)
        return search.way(pose, goal, retreat=retreat)

    def _room(self, now: Array, last: Point | None, discs: Array, share: float) -> Array | None:
        """Return what is to be kept from each disc (M,); None if there is no room at the end.

        now : (M,) gaps where the robot is: what is too near already may not come nearer.
        """
        room = np.minimum(share * self._margin, _kept(now))
        if last is None:
            return room
        there = self.gaps(last, discs)
        if (there < _ROOM_M).any():
            return None
        return np.minimum(room, share * _kept(there))


def _kept(gap: Array) -> Array:
    """Return what is to be kept from discs that leave a gap (M,) where it cannot be helped (m)."""
    return np.maximum(gap - _SLACK_M, np.minimum(gap - 0.2 * _SLACK_M, 0.4 * _SLACK_M))
