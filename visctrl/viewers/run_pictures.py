"""Keeps the frames that a run's pictures are made of, and has them made at its end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from visctrl.contracts import Match
from visctrl.hal.types import Frame
from visctrl.runtime.recorder import FINAL, INITIAL, MCAP, TARGET, VIDEO
from visctrl.runtime.records import Observer, Setup, TickRecord
from visctrl.runtime.run_directory import RunDirectory
from visctrl.viewers.track_history import TrackHistory

if TYPE_CHECKING:
    from visctrl.viewers.foxglove.stream import ViewerStream
    from visctrl.viewers.video.writer import VideoWriter


class Pictures(Observer):
    """The views with their features and tracks, the report, and on demand video and MCAP file.

    The drawing libraries are imported when there is something to draw.

    Parameters
    ----------
    setup : Setup
        Of the run.
    directory : RunDirectory
        Where the pictures go.
    """

    def __init__(self, setup: Setup, directory: RunDirectory) -> None:
        self._setup = setup
        self._path = directory.path
        self._target: Frame | None = None
        self._initial: tuple[Frame, Match] | None = None
        self._last: TickRecord | None = None
        self._tracks = TrackHistory()
        self._video: VideoWriter | None = None
        self._stream: ViewerStream | None = None

    def start_video(self, *, lockstep: bool) -> None:
        """Write every tick into a video, too (see `VideoWriter`)."""
        from visctrl.viewers.video.writer import VideoWriter

        self._video = VideoWriter(self._path / VIDEO, self._setup, lockstep=lockstep)

    def start_mcap(self, *, lockstep: bool) -> None:
        """Write every tick into a file for the Foxglove app, too (see `ViewerStream`)."""
        from visctrl.viewers.foxglove.stream import ViewerStream

        self._stream = ViewerStream.to_file(self._setup, self._path / MCAP, wait=lockstep)

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
        if self._stream is not None:
            self._stream.on_tick(record)

    def close(self) -> list[str]:
        """Finish video and MCAP file; return what the user should know of them."""
        notes = []
        if self._video is not None:
            self._video.close()
            if missing := self._video.given_up:
                notes.append(f"{missing} frames are missing in the video")
        if self._stream is not None:
            self._stream.close()
            if missing := self._stream.given_up:
                notes.append(f"{missing} ticks are missing in {MCAP}")
            if self._stream.problem:
                notes.append(f"{MCAP}: {self._stream.problem}")
        self._video = self._stream = None
        return notes

    def finish(self) -> list[str]:
        """Draw everything that there is to draw; return what the user should know of it."""
        notes = self.close()
        if self._target is None or self._initial is None or self._last is None:
            return notes
        from visctrl.viewers.video.frames import draw_frame, save_picture

        initial, match = self._initial
        count = f"{match.inliers} features"
        last = self._last
        tracks = self._tracks.of(last.views)
        for name, frame, pixels, caption, ways in (
            (TARGET, self._target, match.target_pixels, f"target: {count}", ()),
            (INITIAL, initial, match.initial_pixels, f"initial: {count}", tracks),
            (FINAL, last.frame, last.views.pixels, f"final: {len(last.views)} features", tracks),
        ):
            picture = draw_frame(frame, self._setup.camera, pixels, caption, ways)
            save_picture(self._path / name, picture)
        return notes

    def report(self) -> None:
        """Write the report, from the files of the run: all of them must have been written."""
        from visctrl.viewers.report.run_report import write_report

        write_report(self._path)
