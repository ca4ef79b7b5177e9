"""Landmarks and where they are in a picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

# Drifting tracks can be done without as soon as this many, and this share, are held.
_ENOUGH_HELD, _ENOUGH_HELD_SHARE = 25, 0.5


class Tracks:
    """Landmarks (numbers ``which``, (M,)) at canvas ``points`` (M, 2).

    held : (M,) whether a fixed view's patch was recognised there, so that the track does not
        drift.
    """

    def __init__(self, which: Indices, points: Array, held: Mask | None = None) -> None:
        self.which, self.points = which, points
        self.held = np.zeros(len(which), dtype=np.bool_) if held is None else held

    @classmethod
    def none(cls) -> Tracks:
        """Return no tracks."""
        return cls(np.zeros(0, dtype=np.intp), np.zeros((0, 2)))

    def __len__(self) -> int:
        return len(self.which)

    def subset(self, chosen: Mask | Indices) -> Tracks:
        """Return some of the tracks."""
        return Tracks(self.which[chosen], self.points[chosen], self.held[chosen])

    def without(self, other: Tracks) -> Tracks:
        """Return the tracks of landmarks that ``other`` does not have."""
        return self.subset(~np.isin(self.which, other.which))

    def joined(self, other: Tracks) -> Tracks:
        """Return both; no landmark may be in both."""
        return Tracks(
            np.concatenate([self.which, other.which]),
            np.concatenate([self.points, other.points]),
            np.concatenate([self.held, other.held]),
        )

    def only_held(self) -> Tracks:
        """Return the tracks that are held."""
        return self.subset(self.held)

    def best(self) -> Tracks:
        """Return the tracks that are held if they are enough, else all."""
        held = int(self.held.sum())
        enough = held >= _ENOUGH_HELD and held >= _ENOUGH_HELD_SHARE * len(self)
        return self.only_held() if enough else self
