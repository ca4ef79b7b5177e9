"""A video of a run: what the camera sees with its tracks, and the robot from above."""

from __future__ import annotations

import threading
from collections import deque
from pathlib import Path
from queue import Full, Queue

import cv2
import numpy as np

from visctrl.contracts import Array, Views
from visctrl.hal.types import Pose
from visctrl.robots.errors import InputError
from visctrl.robots.files import utf_8
from visctrl.runtime.records import Observer, Setup, TickRecord
from visctrl.viewers.report.topview import Outline
from visctrl.viewers.trace import Trace
from visctrl.viewers.video.frames import Image, draw_frame
from visctrl.viewers.video.overhead import draw_overhead

#: Frames that may wait for the encoder.
_BACKLOG = 32
#: Length of the tracks (ticks).
_TRAIL = 12
_MOST_POSES = 1000


class VideoWriter(Observer):
    """Writes an MP4, one picture a tick.

    A thread draws and encodes. A run on the wall clock never waits for it: it gives frames up.

    Parameters
    ----------
    path : Path
        The file.
    setup : Setup
        Of the run.
    lockstep : bool
        The run may wait for the encoder.

    Raises
    ------
    InputError
        This OpenCV cannot write MP4 files.
    """

    def __init__(self, path: Path, setup: Setup, *, lockstep: bool) -> None:
        self._camera = setup.camera
        self._outline = Outline.of(setup.robot, setup.mount)
        self._lockstep = lockstep
        self._recent: deque[Views] = deque(maxlen=_TRAIL)
        self._trace = Trace(_MOST_POSES)
        self._queue: Queue[TickRecord | None] = Queue(_BACKLOG)
        self.given_up = 0
        self._closed = False
        codec = cv2.VideoWriter.fourcc(*"mp4v")
        size = (setup.camera.width + setup.camera.height, setup.camera.height)
        # The codec takes even sizes only.
        self._size = (size[0] // 2 * 2, size[1] // 2 * 2)
        if not utf_8(path):
            raise InputError(f"--video: OpenCV takes UTF-8 names only, and {path} is none")
        self._file = cv2.VideoWriter(str(path), codec, setup.scenario.rate_hz, self._size)
        if not self._file.isOpened():
            raise InputError(f"--video: OpenCV cannot write {path}; run without --video")
        self._thread = threading.Thread(target=self._encode_all, name="video", daemon=True)
        self._thread.start()

    def on_tick(self, record: TickRecord) -> None:
        """Queue a tick's frame."""
        if self._lockstep:
            self._queue.put(record)
            return
        try:
            self._queue.put_nowait(record)
        except Full:
            self.given_up += 1

    def close(self) -> None:
        """Encode what is left and close the file; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        self._queue.put(None)
        self._thread.join()
        self._file.release()

    def _encode_all(self) -> None:
        while (record := self._queue.get()) is not None:
            self._file.write(self._draw(record))

    def _draw(self, record: TickRecord) -> Image:
        self._recent.append(record.views)
        pose = record.truth or record.odometry.pose
        self._trace.add(pose)
        caption = f"{record.t:6.1f} s  {record.decision.phase or record.stage}"
        seen = draw_frame(
            record.frame, self._camera, record.views.pixels, caption, self._tracks(record.views)
        )
        target = Pose(0.0, 0.0, 0.0) if record.truth is not None else None
        square = (self._camera.height, self._camera.height)
        above = draw_overhead(square, self._trace.poses, pose, target, self._outline)
        both = np.hstack([seen, above])[: self._size[1], : self._size[0]]
        return np.ascontiguousarray(both)

    def _tracks(self, newest: Views) -> list[Array]:
        """Return where the features have been in the last ticks."""
        ways: dict[int, list[Array]] = {int(name): [] for name in newest.ids}
        for views in self._recent:
            for name, pixel in zip(views.ids.tolist(), views.pixels, strict=True):
                if name in ways:
                    ways[name].append(pixel)
        return [np.array(way) for way in ways.values()]
