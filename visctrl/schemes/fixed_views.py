"""The views that stay while the robot moves, for the features that are seen now."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Views

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Names of the fixed views; the reference is the initial view until another takes its place.
TARGET, REFERENCE, ALIGNED = "target", "reference", "aligned"


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
