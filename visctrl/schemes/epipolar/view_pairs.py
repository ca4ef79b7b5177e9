"""The fixed views, and the motions from them to the current one, tick after tick."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Views
from visctrl.geometry.two_view.degeneracy import Degeneracy
from visctrl.geometry.two_view.planar import PlanarMotion
from visctrl.schemes.epipolar.motion_solvers import PairSolver

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Names of the fixed views; the reference is the initial view until another takes its place.
TARGET, REFERENCE, ALIGNED = "target", "reference", "aligned"
#: A followed motion is kept while this share of the features agrees with it.
_MIN_SHARE = 0.6
#: While the motion is not determined, every so many calls it is looked for anew.
_SEARCH_EVERY = 4


class ViewSet(NamedTuple):
    """N features as P fixed views and the current view see them.

    names : of the fixed views, target and reference first.
    fixed : (P, 3, N) unit rays; the same array as long as nothing but the current view changes.
    current : (3, N) unit rays.
    present : (P, N) features that a fixed view has at all, None for all; the others' rays there
        mean nothing.
    """

    names: tuple[str, ...]
    fixed: Array
    current: Array
    present: Mask | None

    def pair(self, index: int) -> tuple[Array, Array]:
        """Return the rays (N, 3) of the features that a fixed view shares with the current."""
        if self.present is None:
            return self.fixed[index].T, self.current.T
        inside = self.present[index]
        return self.fixed[index].T[inside], self.current.T[inside]


@dataclass(frozen=True)
class _Stored:
    """A past current view: the rays (N, 3) of its features by their names."""

    ids: NDArray[np.int64]
    rays: Array


class FixedViews:
    """Target and initial view, and those that are stored on the way."""

    def __init__(self) -> None:
        self._stored: dict[str, _Stored] = {}
        self._key: tuple[bytes, ...] = ()
        self._names: tuple[str, ...] = ()
        self._fixed: Array = np.zeros((0, 3, 0))
        self._present: Mask | None = None

    def __contains__(self, name: str) -> bool:
        return name in self._stored

    def store(self, name: str, views: Views) -> None:
        """Keep the current view under a name."""
        self._stored[name] = _Stored(views.ids.copy(), views.current.copy())
        self._key = ()

    def see(self, views: Views) -> ViewSet:
        """Return the features of ``views`` in all fixed views and the current one."""
        key = (views.ids.tobytes(), views.target.tobytes(), views.initial.tobytes())
        if key != self._key:
            self._key = key
            self._arrange(views)
        return ViewSet(
            self._names, self._fixed, np.ascontiguousarray(views.current.T), self._present
        )

    def _arrange(self, views: Views) -> None:
        rays, present = [views.target.T], [np.ones(len(views), dtype=np.bool_)]
        names = [TARGET]
        for name in (REFERENCE, ALIGNED):
            stored = self._stored.get(name)
            if stored is not None:
                _, here, there = np.intersect1d(
                    stored.ids, views.ids, assume_unique=True, return_indices=True
                )
                # Rays of the target fill the gaps: they are unit rays, too.
                known, shared = views.target.copy(), np.zeros(len(views), dtype=np.bool_)
                known[there], shared[there] = stored.rays[here], True
                rays.append(known.T)
                present.append(shared)
            elif name == REFERENCE:
                rays.append(views.initial.T)
                present.append(present[0])
            else:
                continue
            names.append(name)
        shared = np.array(present)
        self._names = tuple(names)
        self._fixed = np.array(rays, dtype=np.float64)
        self._present = None if shared.all() else shared


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
