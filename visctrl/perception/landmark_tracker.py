"""Landmarks followed from one initial view on: tracking, holding, judging, finding again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.perception.image_perception import MARGIN_PX
from visctrl.perception.landmarks import Landmarks, Recognised
from visctrl.perception.patch_alignment import Source
from visctrl.perception.pictures import Picture
from visctrl.perception.reacquisition import Reacquisition
from visctrl.perception.selection import spread
from visctrl.perception.template_alignment import TemplateAlignment
from visctrl.perception.three_view import Resection
from visctrl.perception.tracker import follow, returns
from visctrl.perception.tracks import Tracks
from visctrl.perception.unwrap import Canvas

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Standard deviation of a position (px): what is assumed at first, and bounds of what is reported.
_SIGMA_PX, _LEAST_SIGMA_PX, _GREATEST_SIGMA_PX = 0.25, 0.05, 1.0
# Weight of the newest residual in the reported sigma.
_SIGMA_SHARE = 0.2
# Share of the tracks that must agree with one motion before the others are thrown out.
_AGREEMENT = 0.5
# Iterations of the alignment: from where Lucas–Kanade leads, and from further off.
_TRACKING, _SEARCHING = 2, 5
# Lost landmarks looked for in one tick.
_SOUGHT = 40


@dataclass(frozen=True)
class Limits:
    """What the landmark tracker is allowed: see the options of the same names of `Klt`."""

    max_features: int
    min_features: int
    backward_px: float
    refill_share: float
    reacquisition_ticks: int


@dataclass(frozen=True)
class TrackResult:
    """What became of the tracks in a picture.

    tracks : those that agree with one motion; none if too few do.
    recovered : how many of them are back after having been lost.
    complaint : what is wrong; empty if nothing is.
    """

    tracks: Tracks
    recovered: int
    complaint: str


class LandmarkTracker:
    """Follows landmarks through pictures.

    Parameters
    ----------
    landmarks : Landmarks
    picture : Picture
        The initial view, in which they all are.
    canvas : Canvas
        On which the pictures are drawn.
    search : callable
        Recognises landmarks in a picture without knowing where it was taken; called in a thread.
    limits : Limits
    lockstep : bool
        Take the search's results at fixed ticks (see `Reacquisition`).
    """

    def __init__(
        self,
        landmarks: Landmarks,
        picture: Picture,
        canvas: Canvas,
        search: Callable[[Picture], Recognised | None],
        limits: Limits,
        lockstep: bool,
    ) -> None:
        self._canvas, self._limits = canvas, limits
        self._map, self._likeness = landmarks.map, landmarks.likeness
        self._templates = TemplateAlignment(landmarks)
        self._search = Reacquisition(search, canvas, limits.reacquisition_ticks, lockstep)
        self._picture = picture
        every = np.arange(len(landmarks))
        self._tracks = self._chosen(Tracks(every, landmarks.initial.points))
        self._at_start = len(self._tracks)
        self._pose, self._motion = landmarks.map.initial_pose, np.zeros(3)
        self._sigma = _SIGMA_PX / canvas.scale
        self._turn = 0

    @property
    def sigma(self) -> float:
        """Standard deviation of a bearing (rad), from how well the tracks agree."""
        return self._sigma

    @property
    def disagreement(self) -> Array:
        """How far (rad) the fixed views put every landmark apart (see `TemplateAlignment`)."""
        return self._templates.disagreement / self._canvas.scale

    def close(self) -> None:
        """End the thread of the search."""
        self._search.close()

    def advance(self, picture: Picture) -> TrackResult:
        """Find the landmarks in the next picture."""
        source = Source(picture.frame, self._canvas.pixels)
        tracks = self._followed(picture, source)
        fit = self._fit(tracks, self._pose + self._motion)
        found = self._search.take(picture)
        restarted = found is not None and not self._trusted(fit)
        if found is not None and restarted:
            tracks, fit = self._restarted(source, found)
        trusted, before = self._trusted(fit), 0 if restarted else int(fit.inliers.sum())
        if trusted:
            self._motion = np.zeros(3) if restarted else fit.pose - self._pose
            tracks = self._mended(source, tracks, fit, found)
        self._tracks, self._picture = tracks, picture
        if not trusted or len(tracks) < self._limits.refill_share * self._at_start:
            self._search.start(picture)
        if trusted:
            return TrackResult(tracks, len(tracks) - before, "")
        agree, of = int(fit.inliers.sum()), len(fit.inliers)
        return TrackResult(Tracks.none(), 0, f"only {agree} of {of} tracks agree with one motion")

    def _followed(self, picture: Picture, source: Source) -> Tracks:
        """Return the tracks in a new picture, without those that are lost.

        To recognise a fixed view's patch proves more than to track back; only the others have
        to do that.
        """
        before = self._tracks
        moved, kept = follow(self._picture, picture, before.points, self._canvas)
        kept &= self._canvas.inside(moved, MARGIN_PX)
        tracks = self._held(source, Tracks(before.which[kept], moved[kept]), _TRACKING)
        doubtful = np.flatnonzero(kept)[~tracks.held]
        stays = tracks.held.copy()
        stays[~stays] = returns(
            picture,
            self._picture,
            moved[doubtful],
            before.points[doubtful],
            self._canvas,
            self._limits.backward_px,
        )
        return tracks.subset(stays)

    def _restarted(self, source: Source, found: Recognised) -> tuple[Tracks, Resection]:
        """Return tracks of landmarks that were recognised, and how well they agree."""
        self._templates.expect(found.which, found.fit.pose)
        tracks = self._chosen(Tracks(found.which, found.points))
        tracks = self._held(source, tracks, _SEARCHING).only_held()
        return tracks, self._fit(tracks, found.fit.pose)

    def _mended(
        self, source: Source, tracks: Tracks, fit: Resection, found: Recognised | None
    ) -> Tracks:
        """Return the tracks that agree, and lost landmarks found again."""
        self._pose = fit.pose
        self._learn_sigma(fit)
        tracks = tracks.subset(fit.inliers)
        if found is not None:
            back = Tracks(found.which, found.points).without(tracks)
            tracks = tracks.joined(self._agreeing(source, back, len(tracks)))
        return tracks.joined(self._agreeing(source, self._expected(tracks), len(tracks)))

    def _expected(self, tracks: Tracks) -> Tracks:
        """Return some landmarks that are not tracked, where the motion puts them."""
        if len(tracks) >= min(self._limits.max_features, len(self._map)):
            return Tracks.none()
        missing = np.setdiff1d(np.arange(len(self._map)), tracks.which)
        # A different part of them every tick, so that all have their turn.
        sought = np.roll(missing, -self._turn)[:_SOUGHT]
        self._turn = (self._turn + _SOUGHT) % len(missing)
        points = self._canvas.points(self._templates.expect(sought, self._pose))
        seen = self._canvas.inside(points, MARGIN_PX)
        return Tracks(sought[seen], points[seen])

    def _agreeing(self, source: Source, tracks: Tracks, present: int) -> Tracks:
        """Return the tracks that look like their landmarks and agree with the motion.

        ``present`` tracks there are already.
        """
        if len(tracks) == 0:
            return tracks
        tracks = self._held(source, tracks, _SEARCHING).only_held()
        rays = self._canvas.rays(tracks.points)
        agree = self._map.agree(tracks.which, rays, self._pose, self._gate_sigma)
        room = max(self._limits.max_features - present, 0)
        return tracks.subset(np.flatnonzero(agree)[:room])

    def _chosen(self, tracks: Tracks) -> Tracks:
        """Return as many tracks as are to be followed, spread over the picture."""
        quality, shape = self._likeness[tracks.which], self._canvas.shape
        chosen = spread(tracks.points, quality, self._limits.max_features, shape)
        return tracks.subset(np.sort(chosen))

    def _held(self, source: Source, tracks: Tracks, iterations: int) -> Tracks:
        """Return the tracks aligned on the fixed views where these are recognised."""
        anchored = self._templates.hold(source, tracks.which, tracks.points, iterations)
        return Tracks(tracks.which, self._canvas.canonical(anchored.points), anchored.held)

    def _fit(self, tracks: Tracks, start: Array) -> Resection:
        rays = self._canvas.rays(tracks.points)
        return self._map.fit(tracks.which, rays, start, self._gate_sigma)

    def _trusted(self, fit: Resection) -> bool:
        """Whether enough tracks agree for the rest to be in the wrong."""
        return int(fit.inliers.sum()) >= self._limits.min_features and fit.share >= _AGREEMENT

    @property
    def _gate_sigma(self) -> float:
        """What tracks are judged by: never stricter than at the start."""
        return max(self._sigma, _SIGMA_PX / self._canvas.scale)

    def _learn_sigma(self, fit: Resection) -> None:
        low, high = (px / self._canvas.scale for px in (_LEAST_SIGMA_PX, _GREATEST_SIGMA_PX))
        self._sigma += _SIGMA_SHARE * (fit.residual_sd - self._sigma)
        self._sigma = min(max(self._sigma, low), high)
