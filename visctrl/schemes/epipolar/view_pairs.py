"""The epipoles of fixed views and the current one, tick after tick."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.two_view.degeneracy import Degeneracy
from visctrl.geometry.two_view.planar import PlanarMotion
from visctrl.schemes.epipolar.motion_solvers import PairSolver
from visctrl.schemes.fixed_views import ViewSet

Array = NDArray[np.float64]

#: A followed motion is kept while this share of the features agrees with it.
_MIN_SHARE = 0.6
#: While the motion is not determined, every so many calls it is looked for anew.
_SEARCH_EVERY = 4


class PairsFollower:
    """Motions from fixed views to the current one: followed while sound, else searched.

    All pairs that are followed are refined in one go.
    """

    def __init__(self, solver: PairSolver, hypotheses: int) -> None:
        self._solver = solver
        self._hypotheses = hypotheses
        self._last: dict[str, PlanarMotion] = {}
        self._calls: dict[str, int] = {}

    def begin(self, name: str, motion: PlanarMotion | None = None) -> None:
        """Follow the pair of a fixed view from a motion; None where it is the current view."""
        self._last[name] = motion or self._solver.unmoved()

    def update(
        self, sight: ViewSet, sigma: float, turn: float, seed: int
    ) -> dict[str, PlanarMotion]:
        """Return the motion from each fixed view to the current one.

        Parameters
        ----------
        sight : ViewSet
        sigma : float
            Standard deviation of one ray's direction (rad).
        turn : float
            How far the current view turned since the last call (rad, counter-clockwise).
        seed : int
            Of a search from scratch.
        """
        starts = {}
        for index, name in enumerate(sight.names):
            self._calls[name] = self._calls.get(name, -1) + 1
            start = self._start(sight, index, turn, sigma)
            if start is not None:
                starts[index] = start
        found = self._followed(sight, starts, turn, sigma)
        for index, name in enumerate(sight.names):
            motion = found.get(index)
            if motion is None:
                a, b = sight.pair(index)
                motion = self._solver.search(a, b, sigma, self._hypotheses, seed)
            self._last[name] = motion
        return {name: self._last[name] for name in sight.names}

    def _start(self, sight: ViewSet, index: int, turn: float, sigma: float) -> PlanarMotion | None:
        """Return what to follow a pair from; a motion that is not determined may mislead."""
        name = sight.names[index]
        last = self._last[name]
        if not last.found or last.degeneracy is Degeneracy.ONE_PLANE:
            return None
        if last.determined or self._calls[name] % _SEARCH_EVERY != 0:
            return last
        if last.degeneracy in (Degeneracy.IDENTICAL, Degeneracy.SHORT_BASELINE):
            return self._solver.redirected(*sight.pair(index), last, turn, sigma)
        return None

    def _followed(
        self, sight: ViewSet, starts: dict[int, PlanarMotion], turn: float, sigma: float
    ) -> dict[int, PlanarMotion]:
        """Return those motions near their starts that most features agree with."""
        if not starts:
            return {}
        which = list(starts)
        fixed, present = sight.fixed, sight.present
        if len(which) < len(sight.names):
            fixed = fixed[which]
            present = None if present is None else present[which]
        motions = self._solver.follow(
            (fixed, sight.current), present, list(starts.values()), turn, sigma
        )
        found = {}
        for row, (index, motion) in enumerate(zip(which, motions, strict=True)):
            count = len(motion.inliers) if present is None else np.count_nonzero(present[row])
            agreeing = np.count_nonzero(motion.inliers)
            if motion.found and agreeing >= _MIN_SHARE * count:
                found[index] = motion
        return found
