"""A real camera through OpenCV's ``VideoCapture``: device, file or stream.

A thread takes every picture and keeps the newest, so that `read` neither waits nor gets a
picture that has been lying in a buffer.
"""

from __future__ import annotations

import logging
import os
import threading
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.errors import CameraError, StaleFrameError
from visctrl.hal.interfaces import Camera, Clock
from visctrl.hal.types import Frame
from visctrl.robots.documents import StrictModel
from visctrl.robots.files import openable

#: Longest wait for a connection, and for the first picture (s).
_OPEN_S = 3.0
#: A stream that delivers nothing for so long is opened anew (s).
_READ_S = 1.0
_RETRY_S = 0.2
_JOIN_S = 2.5
#: Pictures that a driver buffers, where it lets itself be told.
_BUFFERED = 1
#: Value of OpenCV's auto exposure property for "off" on V4L2.
_MANUAL_EXPOSURE = 1
_DEFAULT_FILE_FPS = 25.0
_FFMPEG_QUIET = "-8"
_MOTION_JPEG = cv2.VideoWriter.fourcc(*"MJPG")
#: Value of OpenCV's format property for packets as they come.
_UNDECODED = -1

_log = logging.getLogger(__name__)


class CaptureOptions(StrictModel):
    """Which camera, and how it is set.

    source : number of a device (``0``), its path (``/dev/video0``), a video file, or the URL of
        a stream (``http://...``, ``rtsp://...``).
    fps : pictures per second to ask for; the camera's own choice if left out.
    exposure : exposure to ask for, in the driver's own units; automatic if left out.
    latency_s : known delay between exposure and arrival, taken off the stamps.
    max_age_s : an older picture is an error: the camera has frozen.
    repeats_are_stale : a picture equal to its predecessor bit by bit is the same picture; with
        the noise of a real sensor it never is. Switch it off for drawn pictures.
    """

    source: str = "0"
    fps: Annotated[float, Field(gt=0.0, le=1000.0)] | None = None
    exposure: float | None = None
    latency_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    max_age_s: Annotated[float, Field(gt=0.0, le=10.0)] = 0.35
    repeats_are_stale: bool = True


class CaptureCamera(Camera):
    """The newest picture of a camera, in grey.

    Parameters
    ----------
    model : CentralCamera
        Calibration; the camera is asked for its size, and must deliver it.
    options : CaptureOptions
        Which camera.
    clock : Clock
        Of the stamps.
    """

    def __init__(self, model: CentralCamera, options: CaptureOptions, clock: Clock) -> None:
        super().__init__(model)
        self._options = options
        self._clock = clock
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._news = threading.Condition()
        self._newest: Frame | None = None
        self._problem = ""
        self._fatal = ""

    def open(self) -> None:
        """Open the camera and wait for its first picture.

        Raises
        ------
        CameraError
            There is no such camera, it delivers nothing, or pictures of another size than the
            calibration's.
        """
        capture = self._connect()
        if capture is None:
            raise CameraError(f"{self._name}: {self._problem}")
        self._thread = threading.Thread(
            target=self._run, args=(capture,), name="camera", daemon=True
        )
        self._thread.start()
        with self._news:
            self._news.wait_for(lambda: self._newest is not None or self._fatal, _OPEN_S)
        if self._newest is None or self._fatal:
            raise CameraError(f"{self._name}: {self._fatal or 'it delivers no picture'}")

    def close(self) -> None:
        """Release the camera. Safe to call twice."""
        self._closing.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(_JOIN_S)
            if thread.is_alive():
                _log.warning("%s: the camera's driver does not let go", self._name)

    def read(self) -> Frame:
        """Return the newest picture.

        Raises
        ------
        CameraError
            There is none, or it has another size than the calibration.
        StaleFrameError
            It is too old: the camera has frozen, or its stream has dropped.
        """
        with self._news:
            frame, fatal, problem = self._newest, self._fatal, self._problem
        if fatal:
            raise CameraError(f"{self._name}: {fatal}")
        if frame is None or self._thread is None:
            raise CameraError(f"{self._name} is not open")
        age = self._clock.now() - frame.stamp
        if age > self._options.max_age_s:
            raise StaleFrameError(
                f"{self._name}: {problem or 'the camera has frozen'}: its newest picture is "
                f"{age:.1f} s old (allowed {self._options.max_age_s:g} s)"
            )
        return frame

    @property
    def _name(self) -> str:
        return f"camera {self._options.source}"

    # --- the camera's thread -----------------------------------------------------------------

    def _run(self, capture: cv2.VideoCapture) -> None:
        """Take pictures until closed; connect again when the stream drops."""
        connected: cv2.VideoCapture | None = capture
        while not self._closing.is_set() and not self._fatal:
            if connected is None:
                self._closing.wait(_RETRY_S)
                connected = self._connect()
                if connected is None:
                    self._problem = "the stream has dropped and cannot be opened again"
                continue
            self._take_all(connected)
            connected.release()
            connected = None

    def _take_all(self, capture: cv2.VideoCapture) -> None:
        """Take pictures until the stream ends."""
        from_file = Path(self._options.source).is_file()
        interval = 1.0 / (capture.get(cv2.CAP_PROP_FPS) or _DEFAULT_FILE_FPS) if from_file else 0.0
        due = self._clock.now()
        while not self._closing.is_set() and not self._fatal:
            if not capture.grab():
                self._fail("the recording has ended" if from_file else "", "the stream has dropped")
                return
            stamp = self._clock.now() - self._options.latency_s
            taken, picture = capture.retrieve()
            grey = _grey(np.asarray(picture)) if taken else None
            if grey is not None:
                self._deliver(grey, stamp)
            due = max(due + interval, stamp)
            if from_file:
                self._clock.sleep_until(due)

    def _deliver(self, grey: NDArray[np.uint8], stamp: float) -> None:
        height, width = grey.shape
        if (width, height) != (self.model.width, self.model.height):
            self._fail(
                f"it delivers {width}x{height}, the calibration '{self.model.name}' is for "
                f"{self.model.width}x{self.model.height}: calibrate it at that size, or set the "
                "camera's size"
            )
            return
        last = self._newest
        repeated = last is not None and np.array_equal(np.asarray(last.image), grey)
        if repeated and self._options.repeats_are_stale:
            return
        sequence = 0 if last is None else last.sequence + 1
        with self._news:
            self._newest = Frame(stamp, sequence, np.asarray(grey, dtype=np.uint8))
            self._problem = ""
            self._news.notify_all()

    def _fail(self, fatal: str, problem: str = "") -> None:
        with self._news:
            self._fatal, self._problem = fatal, problem
            self._news.notify_all()

    # --- connecting ----------------------------------------------------------------------------

    def _connect(self) -> cv2.VideoCapture | None:
        """Return an open camera, or None with the problem noted."""
        _quieten()
        source = self._options.source
        if not openable(source):
            self._problem = "it is neither a device nor a film, or its name is not UTF-8"
            return None
        if source.isdigit():
            capture = cv2.VideoCapture(int(source))
        elif "://" in source:
            limits = [
                cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
                int(_OPEN_S * 1e3),
                cv2.CAP_PROP_READ_TIMEOUT_MSEC,
                int(_READ_S * 1e3),
            ]
            capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)
        else:
            capture = cv2.VideoCapture(source)
        if not capture.isOpened():
            self._problem = f"it cannot be opened; {_remedy(source)}"
            capture.release()
            return None
        self._set_up(capture)
        return capture

    def _set_up(self, capture: cv2.VideoCapture) -> None:
        """Ask for the calibration's size and the wanted settings, where the source can be asked."""
        options = self._options
        if "://" in options.source or Path(options.source).is_file():
            if int(capture.get(cv2.CAP_PROP_FOURCC)) == _MOTION_JPEG:
                # FFmpeg would scale a stream that changes its size back to its first one.
                capture.set(cv2.CAP_PROP_FORMAT, _UNDECODED)
            return
        capture.set(cv2.CAP_PROP_BUFFERSIZE, _BUFFERED)
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, self.model.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self.model.height)
        if options.fps is not None:
            capture.set(cv2.CAP_PROP_FPS, options.fps)
        if options.exposure is not None:
            capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE)
            if not capture.set(cv2.CAP_PROP_EXPOSURE, options.exposure):
                _log.warning("%s does not let its exposure be set", self._name)


def _grey(picture: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
    """Return a decoded picture, or a packet of motion JPEG, in grey; None if it is damaged."""
    if picture.ndim == 3:
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    if min(picture.shape) > 1:
        return picture
    try:
        how = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        decoded = cv2.imdecode(picture.ravel(), how)
    except cv2.error:
        return None
    return None if decoded is None else np.asarray(decoded, dtype=np.uint8)


def camera_devices() -> list[str]:
    """Return the paths of the video devices of this machine (Linux)."""
    return sorted(str(path) for path in Path("/dev").glob("video*"))


def _remedy(source: str) -> str:
    if "://" in source:
        return "check that the stream's server is running and the URL is right"
    if source.isdigit() or source.startswith("/dev/"):
        present = ", ".join(camera_devices()) or "none"
        return f"video devices here: {present}. Is another program using it?"
    return "check that the file exists and is a video"


def _quieten() -> None:
    """Keep OpenCV and FFmpeg from printing what is reported here in a sentence."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", _FFMPEG_QUIET)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
