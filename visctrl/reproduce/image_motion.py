"""Where the features of a run were in the image, tick by tick."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Array, Match
from visctrl.hal.types import Frame
from visctrl.runtime.records import Observer, TickRecord

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FILE = "features.npz"


class ImageMotion(Observer):
    """Collects the features of the main stage, and those of the target view."""

    def __init__(self) -> None:
        self._ids: list[NDArray[np.int64]] = []
        self._pixels: list[Array] = []
        self._target = np.empty((0, 2))

    def on_initial(self, frame: Frame, match: Match) -> None:
        """Take where the target view shows the features."""
        self._target = match.target_pixels

    def on_tick(self, record: TickRecord) -> None:
        """Take where the current view shows them."""
        if record.stage == "main":
            self._ids.append(record.views.ids)
            self._pixels.append(record.views.pixels)

    def save(self, directory: Path) -> None:
        """Write what was collected into the run's directory."""
        np.savez_compressed(
            directory / FILE,
            ids=np.concatenate(self._ids) if self._ids else np.empty(0, dtype=np.int64),
            pixels=np.concatenate(self._pixels) if self._pixels else np.empty((0, 2)),
            target=self._target,
        )


def draw_motion(axis: Axes, directory: Path, title: str) -> None:
    """Draw the way of every feature through the image: start, path, and the target's view."""
    with np.load(directory / FILE) as data:
        ids, pixels, target = data["ids"], data["pixels"], data["target"]
    for feature in np.unique(ids):
        way = pixels[ids == feature]
        axis.plot(way[:, 0], way[:, 1], color="C0", linewidth=0.6, alpha=0.7)
        axis.plot(way[0, 0], way[0, 1], ".", color="C2", markersize=3)
        axis.plot(way[-1, 0], way[-1, 1], "x", color="C0", markersize=4)
    axis.plot(target[:, 0], target[:, 1], "o", color="C3", fillstyle="none", markersize=6)
    axis.set(title=title, xlabel="u (px)", ylabel="v (px)", aspect="equal")
    axis.invert_yaxis()
