"""Perception plugin `klt`: landmarks of the target and initial views, tracked while driving.

Every tick: Lucas–Kanade from the last picture, there and back, on the cylindrical unwrap;
alignment of each track on the patches of the two fixed views; a check that all fit one planar
motion; and a look for lost landmarks where that motion puts them. Where this fails (blackout,
something in front of the camera), SIFT beside the tick recognises the landmarks anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from robots.documents import Document
from visctrl.perception.anchors import Anchors
from visctrl.perception.landmarks import Landmarks, Recognised, recognise
from visctrl.perception.natural import MARGIN_PX, NaturalOptions, NaturalPerception
from visctrl.perception.patches import Values, prepared
from visctrl.perception.pictures import Picture
from visctrl.perception.reacquisition import Reacquisition
from visctrl.perception.selection import spread
from visctrl.perception.three_view import Fit
from visctrl.perception.tracker import follow, returns
from visctrl.plugins import Context, Signal, Views

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

# Standard deviation of a position (px): what is assumed at first, and bounds of what is reported.
_SIGMA_PX, _LEAST_SIGMA_PX, _GREATEST_SIGMA_PX = 0.25, 0.05, 1.0
# A SIFT position before alignment.
_SIFT_SIGMA_PX = 0.5
# Share of the tracks that must agree with one motion before the others are thrown out.
_AGREEMENT = 0.5
# Weight of the newest residual in the reported sigma.
_SIGMA_SHARE = 0.2
# Lost landmarks looked for in one tick.
_SOUGHT = 40
# Drifting tracks are left out as soon as this many, or this share, are held by a fixed view.
_ENOUGH_HELD, _ENOUGH_HELD_SHARE = 25, 0.5


class KltOptions(NaturalOptions):
    """Options of `Klt`; see also `NaturalOptions`.

    max_features : tracks followed, spread over the picture.
    backward_px : greatest error of tracking forth and back.
    refill_share : share of the tracks at the start below which SIFT looks for the lost ones.
    reacquisition_ticks : pictures after which SIFT's result is taken, in lockstep.
    """

    max_features: Annotated[int, Field(ge=10, le=1000)] = 120
    backward_px: Annotated[float, Field(gt=0, le=5)] = 0.5
    refill_share: Annotated[float, Field(ge=0, le=1)] = 0.6
    reacquisition_ticks: Annotated[int, Field(ge=1, le=20)] = 5


class Klt(NaturalPerception[KltOptions]):
    """Pyramidal Lucas–Kanade with anchors in both fixed views, and re-acquisition."""

    Options: ClassVar[type[Document]] = KltOptions
    signals = (
        Signal("features_tracked", "1"),
        Signal("features_held", "1"),
        Signal("features_recovered", "1"),
        Signal("bearing_sigma", "rad"),
    )

    def __init__(self, options: KltOptions, context: Context) -> None:
        super().__init__(options, context)
        self._search: Reacquisition | None = None
        self._values: dict[str, float] = {}

    def values(self) -> Mapping[str, float]:
        """Return how many features the last new frame had, and how they were found."""
        return self._values

    def close(self) -> None:
        """End the thread of the re-acquisition."""
        if self._search is not None:
            self._search.close()

    def _begin(self, picture: Picture, landmarks: Landmarks) -> None:
        self.close()
        seed, canvas, options = self.context.seed, self.canvas, self.options
        sift_sigma = _SIFT_SIGMA_PX / canvas.scale

        def search(seen: Picture) -> Recognised | None:
            return recognise(self._describe(seen.image), landmarks, canvas, sift_sigma, seed)

        self._search = Reacquisition(
            search, canvas, options.reacquisition_ticks, self.context.lockstep
        )
        self._map = landmarks.map
        self._anchors = Anchors(landmarks)
        self._picture = picture
        self._likeness = landmarks.likeness
        every = np.arange(len(landmarks))
        self._tracks = self._chosen(_Tracks(every, landmarks.initial.points))
        self._at_start = len(self._tracks)
        self._pose = landmarks.map.initial_pose
        self._sigma = _SIGMA_PX / canvas.scale
        self._turn = 0
        self._values = {}

    def _measure(self, picture: Picture, stamp: float) -> Views:
        assert self._search is not None
        values = prepared(picture.image)
        tracks = self._followed(picture, values)
        fit = self._fit(tracks, self._pose)
        found = self._search.take(picture)
        recovered = 0
        if found is not None and not self._trusted(fit):
            self._anchors.expect(found.which, found.fit.pose)
            tracks = self._chosen(_Tracks(found.which, found.points))
            tracks = self._held(values, tracks).only_held()
            fit = self._fit(tracks, found.fit.pose)
            recovered = len(tracks)
        trusted = self._trusted(fit)
        if trusted:
            self._pose = fit.pose
            self._learn_sigma(fit)
            tracks = tracks.subset(fit.inliers)
            sought = self._recovered(values, tracks)
            recovered += len(sought)
            tracks = tracks.joined(sought)
        self._tracks, self._picture = tracks, picture
        if not trusted or len(tracks) < self.options.refill_share * self._at_start:
            self._search.start(picture)
        self._count(tracks, recovered)
        if not trusted:
            agree = int(fit.inliers.sum())
            return self._nothing(
                stamp, f"only {agree} of {len(fit.inliers)} tracks agree with one motion"
            )
        shown = tracks.only_held() if tracks.mostly_held else tracks
        return self._views(shown.which, shown.points, self._sigma, stamp)

    def _followed(self, picture: Picture, values: Values) -> _Tracks:
        """Return the tracks in a new picture, without those that are lost.

        To recognise a fixed view's patch proves more than to track back; only the others have
        to do that.
        """
        before = self._tracks
        moved, kept = follow(self._picture, picture, before.points, self.canvas)
        kept &= self.canvas.inside(moved, MARGIN_PX)
        tracks = self._held(values, _Tracks(before.which[kept], moved[kept]))
        doubtful = np.flatnonzero(kept)[~tracks.held]
        returned = returns(
            picture,
            self._picture,
            moved[doubtful],
            before.points[doubtful],
            self.canvas,
            self.options.backward_px,
        )
        kept = tracks.held.copy()
        kept[~kept] = returned
        return tracks.subset(kept)

    def _chosen(self, tracks: _Tracks) -> _Tracks:
        """Return as many tracks as are to be followed, spread over the picture."""
        count, shape = self.options.max_features, self.canvas.shape
        return tracks.subset(
            np.sort(spread(tracks.points, self._likeness[tracks.which], count, shape))
        )

    def _held(self, values: Values, tracks: _Tracks) -> _Tracks:
        """Return the tracks aligned on the fixed views where these are recognised."""
        anchored = self._anchors.hold(values, tracks.which, tracks.points)
        return _Tracks(tracks.which, self.canvas.canonical(anchored.points), anchored.held)

    def _fit(self, tracks: _Tracks, start: Array) -> Fit:
        rays = self.canvas.rays(tracks.points)
        return self._map.fit(tracks.which, rays, start, self._gate_sigma)

    def _trusted(self, fit: Fit) -> bool:
        """Whether enough tracks agree for the rest to be in the wrong."""
        return int(fit.inliers.sum()) >= self.options.min_features and fit.share >= _AGREEMENT

    def _recovered(self, values: Values, tracks: _Tracks) -> _Tracks:
        """Return landmarks that are not tracked but found where the motion puts them."""
        missing = np.setdiff1d(np.arange(len(self._map)), tracks.which)
        room = self.options.max_features - len(tracks)
        if len(missing) == 0 or room <= 0:
            return _Tracks.none()
        # A different part of them every tick, so that all have their turn.
        sought = np.roll(missing, -self._turn)[:_SOUGHT]
        self._turn = (self._turn + _SOUGHT) % len(missing)
        expected = self.canvas.points(self._anchors.expect(sought, self._pose))
        seen = self.canvas.inside(expected, MARGIN_PX)
        found = self._held(values, _Tracks(sought[seen], expected[seen])).only_held()
        rays = self.canvas.rays(found.points)
        agree = self._map.agree(found.which, rays, self._pose, self._gate_sigma)
        return found.subset(np.flatnonzero(agree)[:room])

    @property
    def _gate_sigma(self) -> float:
        return max(self._sigma, _SIGMA_PX / self.canvas.scale)

    def _learn_sigma(self, fit: Fit) -> None:
        low, high = _LEAST_SIGMA_PX / self.canvas.scale, _GREATEST_SIGMA_PX / self.canvas.scale
        self._sigma += _SIGMA_SHARE * (fit.residual_sd - self._sigma)
        self._sigma = min(max(self._sigma, low), high)

    def _count(self, tracks: _Tracks, recovered: int) -> None:
        self._values = {
            "features_tracked": float(len(tracks)),
            "features_held": float(tracks.held.sum()),
            "features_recovered": float(recovered),
            "bearing_sigma": self._sigma,
        }


class _Tracks:
    """Landmarks (numbers ``which``, (M,)) at canvas ``points`` (M, 2).

    held : (M,) whether a fixed view's patch was recognised there.
    """

    def __init__(self, which: Indices, points: Array, held: Mask | None = None) -> None:
        self.which, self.points = which, points
        self.held = np.zeros(len(which), dtype=np.bool_) if held is None else held

    @classmethod
    def none(cls) -> _Tracks:
        return cls(np.zeros(0, dtype=np.intp), np.zeros((0, 2)))

    def __len__(self) -> int:
        return len(self.which)

    @property
    def mostly_held(self) -> bool:
        held = int(self.held.sum())
        return held >= _ENOUGH_HELD and held >= _ENOUGH_HELD_SHARE * len(self)

    def subset(self, chosen: Mask | Indices) -> _Tracks:
        return _Tracks(self.which[chosen], self.points[chosen], self.held[chosen])

    def only_held(self) -> _Tracks:
        return self.subset(self.held)

    def joined(self, other: _Tracks) -> _Tracks:
        return _Tracks(
            np.concatenate([self.which, other.which]),
            np.concatenate([self.points, other.points]),
            np.concatenate([self.held, other.held]),
        )
