"""Perception plugin `klt`: landmarks of the target and initial views, tracked while driving.

Every tick: Lucas–Kanade from the last picture, on the cylindrical unwrap; alignment of each
track on the patches of the two fixed views, or the test of the way back; a check that all fit
one planar motion; and a look for lost landmarks where that motion puts them. Where this fails
(blackout, something in front of the camera), SIFT beside the tick recognises them anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

from pydantic import Field

from visctrl.contracts import Context, Signal, Views
from visctrl.perception.image_perception import ImagePerception, ImagePerceptionOptions
from visctrl.perception.landmark_tracker import LandmarkTracker, Limits
from visctrl.perception.landmarks import Landmarks, Recognised, recognise
from visctrl.perception.pictures import Picture
from visctrl.robots.documents import StrictModel

# Standard deviation of a SIFT position before alignment (px).
_SIFT_SIGMA_PX = 0.5


class KltOptions(ImagePerceptionOptions):
    """Options of `Klt`; see also `ImagePerceptionOptions`.

    max_features : tracks followed, spread over the picture.
    backward_px : greatest error of tracking forth and back.
    refill_share : share of the tracks at the start below which SIFT looks for the lost ones.
    reacquisition_ticks : pictures after which SIFT's result is taken, in lockstep.
    """

    max_features: Annotated[int, Field(ge=10, le=1000)] = 120
    backward_px: Annotated[float, Field(gt=0, le=5)] = 0.5
    refill_share: Annotated[float, Field(ge=0, le=1)] = 0.6
    reacquisition_ticks: Annotated[int, Field(ge=1, le=20)] = 5


class Klt(ImagePerception[KltOptions]):
    """Pyramidal Lucas–Kanade with anchors in both fixed views, and re-acquisition."""

    Options: ClassVar[type[StrictModel]] = KltOptions
    signals = (
        Signal("features_tracked", "1"),
        Signal("features_held", "1"),
        Signal("features_recovered", "1"),
        Signal("bearing_sigma", "rad"),
    )

    def __init__(self, options: KltOptions, context: Context) -> None:
        super().__init__(options, context)
        self._tracker: LandmarkTracker | None = None
        self._values: dict[str, float] = {}

    def values(self) -> Mapping[str, float]:
        """Return how many features the last usable frame had, and how they were found."""
        return self._values

    def close(self) -> None:
        """End the thread of the re-acquisition."""
        if self._tracker is not None:
            self._tracker.close()

    def _begin(self, picture: Picture, landmarks: Landmarks) -> None:
        self.close()
        seed, canvas, options = self.context.seed, self.canvas, self.options

        def search(seen: Picture) -> Recognised | None:
            described = self._describe(seen.image)
            return recognise(described, landmarks, canvas, _SIFT_SIGMA_PX / canvas.scale, seed)

        limits = Limits(
            max_features=options.max_features,
            min_features=options.min_features,
            backward_px=options.backward_px,
            refill_share=options.refill_share,
            reacquisition_ticks=options.reacquisition_ticks,
        )
        self._tracker = LandmarkTracker(
            landmarks, picture, canvas, search, limits, self.context.lockstep
        )
        self._values = {}

    def _measure(self, picture: Picture, stamp: float) -> Views:
        assert self._tracker is not None
        result = self._tracker.advance(picture)
        tracks, sigma = result.tracks, self._tracker.sigma
        self._values = {
            "features_tracked": float(len(tracks)),
            "features_held": float(tracks.held.sum()),
            "features_recovered": float(result.recovered),
            "bearing_sigma": sigma,
        }
        if result.complaint:
            return self._nothing(stamp, result.complaint)
        shown = tracks.best()
        # Where the two fixed views disagree, a track between them moves from one to the other.
        doubts = self._tracker.disagreement
        return self._views(shown.which, shown.points, sigma, stamp, doubts)
