"""A video of what the camera sees, features marked, encoded beside the run."""

from __future__ import annotations

import threading
from pathlib import Path
from queue import Full, Queue

import cv2

from hal.central_camera import CentralCamera
from robots.errors import InputError
from visctrl.report.frames import draw_frame
from visctrl.runtime.records import Observer, TickRecord

#: Frames that may wait for the encoder.
_BACKLOG = 32


class VideoWriter(Observer):
    """Writes an MP4, one picture a tick.

    A thread draws and encodes. A run on the wall clock never waits for it: it gives frames up.

    Parameters
    ----------
    path : Path
        The file.
    camera : CentralCamera
        Gives the size of frames without an image.
    rate : float
        Pictures a second.
    lockstep : bool
        The run may wait for the encoder.

    Raises
    ------
    InputError
        This OpenCV cannot write MP4 files.
    """

    def __init__(self, path: Path, camera: CentralCamera, rate: float, *, lockstep: bool) -> None:
        self._camera = camera
        self._lockstep = lockstep
        self._queue: Queue[TickRecord | None] = Queue(_BACKLOG)
        self.given_up = 0
        codec = cv2.VideoWriter.fourcc(*"mp4v")
        self._file = cv2.VideoWriter(str(path), codec, rate, (camera.width, camera.height))
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
        """Encode what is left and close the file."""
        self._queue.put(None)
        self._thread.join()
        self._file.release()

    def _encode_all(self) -> None:
        while (record := self._queue.get()) is not None:
            caption = f"{record.t:6.1f} s  {record.decision.phase or record.stage}"
            self._file.write(draw_frame(record.frame, self._camera, record.views.pixels, caption))
