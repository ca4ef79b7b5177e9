"""Where each feature has been in the image, in bounded memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Array, Views

#: Most views kept; a longer drive keeps every second, fourth, ... tick.
_MOST_KEPT = 128


class TrackHistory:
    """Keeps the positions of features over a run's ticks.

    When there are too many, every second view is dropped and from then on only every second one
    is taken, so that a run of any length leaves tracks of its whole length.
    """

    def __init__(self) -> None:
        self._kept: list[tuple[NDArray[np.int64], Array]] = []
        self._stride = 1
        self._seen = 0

    def clear(self) -> None:
        """Start anew."""
        self._kept.clear()
        self._stride, self._seen = 1, 0

    def add(self, views: Views) -> None:
        """Take a tick's features; they are kept as they are, not copied."""
        if self._seen % self._stride == 0 and len(views):
            self._kept.append((views.ids, views.pixels))
            if len(self._kept) > _MOST_KEPT:
                del self._kept[1::2]
                self._stride *= 2
        self._seen += 1

    def of(self, views: Views) -> list[Array]:
        """Return the track (K, 2) of every feature of ``views``, in order; it ends there."""
        tracks: dict[int, list[Array]] = {int(name): [] for name in views.ids}
        for ids, pixels in self._kept:
            for name, pixel in zip(ids.tolist(), pixels, strict=True):
                if name in tracks:
                    tracks[name].append(pixel)
        for name, pixel in zip(views.ids.tolist(), views.pixels, strict=True):
            tracks[name].append(pixel)
        return [np.array(track) for track in tracks.values()]
