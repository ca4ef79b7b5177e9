"""Keeps the frames that a run's pictures are made of, and has them made at its end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from visctrl.contracts import Match
from visctrl.hal.types import Frame
from visctrl.runtime.plan import Plan
from visctrl.runtime.recorder import FINAL, INITIAL, MCAP, TARGET, VIDEO
from visctrl.runtime.records import Observer, Setup, TickRecord
from visctrl.runtime.run_directory import RunDirectory
from visctrl.runtime.session import Outcome, run_session
from visctrl.runtime.stop import StopRequest
from visctrl.viewers.track_history import TrackHistory

if TYPE_CHECKING:
    from visctrl.viewers.foxglove.stream import ViewerStream
    from visctrl.viewers.video.writer import VideoWriter


def run_with_pictures(
    plan: Plan,
    out: Path | RunDirectory,
    *,
    video: bool = False,
    mcap: bool = False,
    observers: Sequence[Observer] = (),
    stop: StopRequest | None = None,
) -> Outcome:
    """Run a plan to its end with everything that can be looked at afterwards (see `run_session`).

    Parameters
    ----------
    plan, out, observers, stop
        See `run_session`.
    video, mcap : bool
        See `Pictures`.
    """
    directory = RunDirectory(out) if isinstance(out, Path) else out
    pictures = Pictures(plan, directory.path, video=video, mcap=mcap)
    return run_session(plan, directory, observers=[*observers, pictures], stop=stop)


class Pictures(Observer):
    """The views with their features and tracks, the report, and on demand video and MCAP file.

    The drawing libraries are imported when there is something to draw.

    Parameters
    ----------
    setup : Setup
        Of the run.
    path : Path
        Run directory, where the pictures go.
    video : bool
        Also write an MP4 of the camera's images and the robot from above (see `VideoWriter`).
    mcap : bool
        Also write a file for the Foxglove app (see `ViewerStream`).
    """

    def __init__(
        self, setup: Setup, path: Path, *, video: bool = False, mcap: bool = False
    ) -> None:
        self._setup = setup
        self._path = path
        self._wants_video, self._wants_mcap = video, mcap
        self._target: Frame | None = None
        self._initial: tuple[Frame, Match] | None = None
        self._last: TickRecord | None = None
        self._tracks = TrackHistory()
        self._begun = False
        self._video: VideoWriter | None = None
        self._stream: ViewerStream | None = None

    def on_begin(self, *, lockstep: bool) -> None:
        """Open what is written tick by tick."""
        self._begun = True
        if self._wants_video:
            from visctrl.viewers.video.writer import VideoWriter

            self._video = VideoWriter(self._path / VIDEO, self._setup, lockstep=lockstep)
        if self._wants_mcap:
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

    def on_end(self) -> list[str]:
        """Draw everything that there is to draw; return what the user should know of it."""
        self.close()
        try:
            self._draw()
        finally:
            if self._begun:
                self._report()
        return self._missing()

    def close(self) -> None:
        """Finish video and MCAP file."""
        if self._video is not None:
            self._video.close()
        if self._stream is not None:
            self._stream.close()

    def _missing(self) -> list[str]:
        notes = []
        if self._video is not None and self._video.given_up:
            notes.append(f"{self._video.given_up} frames are missing in the video")
        if self._stream is not None:
            if self._stream.given_up:
                notes.append(f"{self._stream.given_up} ticks are missing in {MCAP}")
            if self._stream.problem:
                notes.append(f"{MCAP}: {self._stream.problem}")
        return notes

    def _draw(self) -> None:
        if self._target is None or self._initial is None or self._last is None:
            return
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

    def _report(self) -> None:
        """Write the report from the files of the run, all of which are written by now."""
        from visctrl.viewers.report.run_report import write_report

        write_report(self._path)
