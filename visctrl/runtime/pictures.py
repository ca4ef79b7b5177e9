"""Keeps the frames that a run's pictures are made of, and has them made at its end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from hal.central_camera import CentralCamera
from hal.types import Frame
from visctrl.plugins import Match
from visctrl.report.tracks import TrackHistory
from visctrl.runtime.recorder import FINAL, INITIAL, TARGET, VIDEO, RunDirectory
from visctrl.runtime.records import Observer, TickRecord

if TYPE_CHECKING:
    from visctrl.report.tracks import TrackHistory
    from visctrl.report.video import VideoWriter


class Pictures(Observer):
    """Target, initial and final view with their features and tracks, the report, the video.

    The drawing libraries are imported when there is something to draw.

    Parameters
    ----------
    camera : CentralCamera
        Its size is the canvas of frames that carry no image.
    directory : RunDirectory
        Where the pictures go.
    """

    def __init__(self, camera: CentralCamera, directory: RunDirectory) -> None:
        self._camera = camera
        self._path = directory.path
        self._target: Frame | None = None
        self._initial: tuple[Frame, Match] | None = None
        self._last: TickRecord | None = None
        self._tracks = TrackHistory()
        self._video: VideoWriter | None = None

    def start_video(self, rate: float, *, lockstep: bool) -> None:
        """Write the frames of every tick as a video, too (see `VideoWriter`)."""
        from visctrl.report.video import VideoWriter

        self._video = VideoWriter(self._path / VIDEO, self._camera, rate, lockstep=lockstep)

    def on_target(self, frames: Sequence[Frame]) -> None:
        """Keep a frame of the target view."""
        self._target = frames[0]

    def on_initial(self, frame: Frame, match: Match) -> None:
        """Keep the newest initial view; tracks begin there."""
        self._initial = (frame, match)
        self._tracks.clear()

    def on_tick(self, record: TickRecord) -> None:
        """Keep the newest tick."""
        self._last = record
        self._tracks.add(record.views)
        if self._video is not None:
            self._video.on_tick(record)

    def finish(self) -> str:
        """Draw everything that there is to draw; return what the user should know of it."""
        note = self._finish_video()
        if self._target is None or self._initial is None or self._last is None:
            return note
        from visctrl.report.frames import draw_frame, save_picture

        initial, match = self._initial
        count = f"{match.inliers} features"
        last = self._last
        tracks = self._tracks.of(last.views)
        for name, frame, pixels, caption, ways in (
            (TARGET, self._target, match.target_pixels, f"target: {count}", ()),
            (INITIAL, initial, match.initial_pixels, f"initial: {count}", tracks),
            (FINAL, last.frame, last.views.pixels, f"final: {len(last.views)} features", tracks),
        ):
            picture = draw_frame(frame, self._camera, pixels, caption, ways)
            save_picture(self._path / name, picture)
        return note

    def report(self) -> None:
        """Write the report, from the files of the run: all of them must have been written."""
        from visctrl.report.run_report import write_report

        write_report(self._path)

    def _finish_video(self) -> str:
        if self._video is None:
            return ""
        self._video.close()
        missing = self._video.given_up
        return f"{missing} frames are missing in the video" if missing else ""
