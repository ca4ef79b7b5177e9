"""The path driven so far, in bounded memory, for those who watch while it grows."""

from __future__ import annotations

import math

from visctrl.hal.types import Pose

#: A new point after so much way (m) or turn (rad).
_EVERY = (0.01, math.radians(2.0))


class Trace:
    """Poses spaced by way and turn; with too many, every second is dropped.

    Parameters
    ----------
    most : int
        Poses kept at most.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._spacing = 1.0
        self.poses: list[Pose] = []
        #: Counts how often poses have been dropped: between two counts the list only grows.
        self.edition = 0

    def add(self, pose: Pose) -> None:
        """Take a pose if the robot has moved; one that is not finite is left out."""
        if not all(map(math.isfinite, pose)):
            return
        if self.poses:
            last = self.poses[-1]
            way = math.dist(pose[:2], last[:2]) / _EVERY[0]
            if way + abs(pose.phi - last.phi) / _EVERY[1] < self._spacing:
                return
        self.poses.append(pose)
        if len(self.poses) > self._most:
            del self.poses[1::2]
            self._spacing *= 2.0
            self.edition += 1
