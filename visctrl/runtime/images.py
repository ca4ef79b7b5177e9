"""A run's images on disk: every frame that a tick used, lossless, and a list of them.

``images/`` in the run directory holds PNG files as the camera delivered them, ``camera.yaml``
and ``index.csv``: one row for each use of a frame, in order. A frame used twice is one file.
"""

from __future__ import annotations

import csv
import threading
from collections.abc import Sequence
from pathlib import Path
from queue import Full, Queue
from typing import TextIO

import numpy as np
import yaml
from numpy.typing import NDArray

from visctrl.contracts import Match
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Frame
from visctrl.robots.errors import DiskError
from visctrl.robots.files import write_bytes, write_text
from visctrl.runtime.recorder import IMAGES
from visctrl.runtime.records import Observer, TickRecord

INDEX, CAMERA = "index.csv", "camera.yaml"
#: What a frame was used for.
TARGET, INITIAL, TICK = "target", "initial", "tick"
HEADER = ("role", "tick", "sequence", "stamp [s]", "age [s]", "file")

#: Frames that may wait to be written (half a megabyte each).
_BACKLOG = 64
#: Fastest PNG compression: the rest saves a tenth and costs five times the time.
_COMPRESSION = 1

Row = tuple[object, ...]


class ImageRecorder(Observer):
    """Writes frames as PNG from a thread.

    A run on the wall clock never waits for the disk: frames are given up, and counted.

    Parameters
    ----------
    directory : Path
        The run directory.
    camera : CentralCamera
        Written beside the images, so that they can be used without the run.
    """

    def __init__(self, directory: Path, camera: CentralCamera) -> None:
        self._folder = directory / IMAGES
        self._camera = camera
        #: Whether a tick may wait for the disk.
        self.may_wait = True
        #: What went wrong, empty if nothing, and whether images are cut short.
        self.problem = ""
        self.failed = False
        self._given_up = 0
        self._targets = 0
        self._last: tuple[int, str] | None = None
        self._queue: Queue[tuple[Row, NDArray[np.uint8] | None] | None] = Queue(_BACKLOG)
        self._thread: threading.Thread | None = None

    def on_target(self, frames: Sequence[Frame]) -> None:
        """Write the frames of the target view."""
        for frame in frames:
            name = f"target-{self._targets}.png"
            self._targets += 1
            self._put((TARGET, "", frame.sequence, frame.stamp, 0.0, name), frame.image, wait=True)

    def on_initial(self, frame: Frame, match: Match) -> None:
        """Write an initial view."""
        self._use(INITIAL, "", frame, 0.0, wait=True)

    def on_tick(self, record: TickRecord) -> None:
        """Write the frame of a tick.

        Raises
        ------
        DiskError
            Writing has failed: a run that shall keep its images ends where it cannot.
        """
        if self.failed:
            raise DiskError(self.problem)
        age = record.tick.start - record.frame.stamp
        self._use(TICK, record.number, record.frame, age, wait=self.may_wait)

    def close(self) -> None:
        """Write what is left."""
        if self._thread is not None:
            self._queue.put(None)
            self._thread.join()
            self._thread = None
        if self._given_up and not self.problem:
            self.problem = f"{self._given_up} images were not recorded: the disk was too slow"

    def _use(self, role: str, tick: int | str, frame: Frame, age: float, *, wait: bool) -> None:
        known = self._last is not None and self._last[0] == frame.sequence
        name = self._last[1] if self._last and known else f"{frame.sequence:06d}.png"
        row = (role, tick, frame.sequence, frame.stamp, age, name)
        if self._put(row, None if known else frame.image, wait=wait):
            self._last = frame.sequence, name

    def _put(self, row: Row, image: NDArray[np.uint8] | None, *, wait: bool) -> bool:
        if self._thread is None:
            self._thread = threading.Thread(target=self._write_all, name="images", daemon=True)
            self._thread.start()
        try:
            self._queue.put((row, image), block=wait)
        except Full:
            self._given_up += 1
            return False
        return True

    def _write_all(self) -> None:
        index = None
        try:
            index = self._open()
            rows = csv.writer(index, lineterminator="\n")
            rows.writerow(HEADER)
            while (item := self._queue.get()) is not None:
                row, image = item
                if image is not None:
                    self._save(str(row[-1]), image)
                rows.writerow(row)
                index.flush()
        except OSError as error:
            self.problem = f"recording images ended early: {error.strerror or error}"
            self.failed = True
            while self._queue.get() is not None:
                pass
        finally:
            if index is not None:
                index.close()

    def _open(self) -> TextIO:
        self._folder.mkdir(exist_ok=True)
        text = yaml.safe_dump(self._camera.model_dump(mode="json"), sort_keys=False)
        write_text(self._folder / CAMERA, text)
        return (self._folder / INDEX).open("w", encoding="utf-8", newline="")

    def _save(self, name: str, image: NDArray[np.uint8]) -> None:
        import cv2

        ok, data = cv2.imencode(".png", image, (cv2.IMWRITE_PNG_COMPRESSION, _COMPRESSION))
        if not ok:
            raise OSError(f"{name} cannot be encoded as PNG")
        write_bytes(self._folder / name, data.tobytes())
