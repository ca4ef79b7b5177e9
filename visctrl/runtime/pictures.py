"""Keeps the frames that a run's pictures are made of, and has them made at its end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from hal.central_camera import CentralCamera
from hal.types import Frame
from visctrl.plugins import Match
from visctrl.runtime.recorder import FINAL, INITIAL, PLOTS, TARGET, VIDEO, RunDirectory
from visctrl.runtime.records import Observer, TickRecord

if TYPE_CHECKING:
    from visctrl.report.video import VideoWriter


class Pictures(Observer):
    """Target, initial and final view with their features, the plot page, the video.

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
        self._video: VideoWriter | None = None

    def start_video(self, rate: float, *, lockstep: bool) -> None:
        """Write the frames of every tick as a video, too (see `VideoWriter`)."""
        from visctrl.report.video import VideoWriter

        self._video = VideoWriter(self._path / VIDEO, self._camera, rate, lockstep=lockstep)

    def on_target(self, frames: Sequence[Frame]) -> None:
        """Keep a frame of the target view."""
        self._target = frames[0]

    def on_initial(self, frame: Frame, match: Match) -> None:
        """Keep the newest initial view."""
        self._initial = (frame, match)

    def on_tick(self, record: TickRecord) -> None:
        """Keep the newest tick."""
        self._last = record
        if self._video is not None:
            self._video.on_tick(record)

    def finish(self) -> str:
        """Draw everything that there is to draw; return what the user should know of it."""
        note = self._finish_video()
        if self._target is None or self._initial is None or self._last is None:
            return note
        from visctrl.report.frames import draw_frame, save_picture
        from visctrl.report.plots import plot_run

        initial, match = self._initial
        count = f"{match.inliers} features"
        last = self._last
        for name, frame, pixels, caption in (
            (TARGET, self._target, match.target_pixels, f"target: {count}"),
            (INITIAL, initial, match.initial_pixels, f"initial: {count}"),
            (FINAL, last.frame, last.views.pixels, f"final: {len(last.views)} features"),
        ):
            save_picture(self._path / name, draw_frame(frame, self._camera, pixels, caption))
        plot_run(self._path, self._path / PLOTS)
        return note

    def _finish_video(self) -> str:
        if self._video is None:
            return ""
        self._video.close()
        missing = self._video.given_up
        return f"{missing} frames are missing in the video" if missing else ""
