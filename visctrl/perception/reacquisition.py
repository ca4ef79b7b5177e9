"""Recognition of landmarks beside the tick: in a thread, with what it finds brought up to date."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from visctrl.perception.landmarks import Recognised
from visctrl.perception.pictures import Picture
from visctrl.perception.tracker import follow
from visctrl.perception.unwrap import Canvas

Array = NDArray[np.float64]

# A search that has not come back after this many pictures is about a place long left.
_MAX_PICTURES = 20


class Reacquisition:
    """One search at a time, in one thread.

    Parameters
    ----------
    search : callable
        Finds landmarks in a picture; it must not touch anything that the tick changes.
    canvas : Canvas
        On which the pictures are drawn.
    ticks : int
        In lockstep, the number of pictures after which the result is taken, waiting for it if
        need be, so that a run does not depend on the speed of the machine.
    lockstep : bool
        Otherwise the result is taken at the first picture for which it is ready.
    """

    def __init__(
        self,
        search: Callable[[Picture], Recognised | None],
        canvas: Canvas,
        ticks: int,
        lockstep: bool,
    ) -> None:
        self._search, self._canvas = search, canvas
        self._ticks, self._lockstep = ticks, lockstep
        self._executor: ThreadPoolExecutor | None = None
        self._future: Future[Recognised | None] | None = None
        self._pictures: list[Picture] = []

    def start(self, picture: Picture) -> None:
        """Search in a picture, unless a search is under way."""
        if self._future is not None:
            return
        if self._executor is None:
            self._executor = ThreadPoolExecutor(1, thread_name_prefix="reacquisition")
        self._pictures = [picture]
        self._future = self._executor.submit(self._search, picture)

    def take(self, picture: Picture) -> Recognised | None:
        """Return what was found, with its points followed to this picture, once it is due.

        To be called with every picture after the one that the search began with.
        """
        if self._future is None:
            return None
        self._pictures.append(picture)
        if not (len(self._pictures) > self._ticks if self._lockstep else self._future.done()):
            return None
        found, pictures = self._future.result(), self._pictures
        self._future, self._pictures = None, []
        if found is None or len(pictures) > _MAX_PICTURES:
            return None
        return self._brought_forward(found, pictures)

    def close(self) -> None:
        """End the thread; a search under way is waited for."""
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)
        self._executor, self._future, self._pictures = None, None, []

    def _brought_forward(self, found: Recognised, pictures: list[Picture]) -> Recognised:
        """Follow points through a chain of pictures; those lost on the way are left out.

        One way only: what goes astray does not survive the comparison with the fixed views.
        """
        which, points = found.which, found.points
        for before, after in pairwise(pictures):
            points, kept = follow(before, after, points, self._canvas)
            which, points = which[kept], points[kept]
        return Recognised(which, points, found.fit)
