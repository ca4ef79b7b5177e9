"""Perception plugin `sift`: features found and matched anew in every frame.

Nothing drifts and nothing is remembered, but positions jump from frame to frame and a frame
costs several ticks: it is for replaying recorded images and for comparison with `klt`.
"""

from __future__ import annotations

from typing import ClassVar

from visctrl.contracts import Views
from visctrl.perception.image_perception import ImagePerception, ImagePerceptionOptions
from visctrl.perception.landmarks import Landmarks, recognise
from visctrl.perception.pictures import Picture
from visctrl.robots.documents import StrictModel

# Standard deviation of a SIFT keypoint's position (px).
_SIGMA_PX = 0.4


class SiftOptions(ImagePerceptionOptions):
    """Options of `Sift`; see `ImagePerceptionOptions`."""


class Sift(ImagePerception[SiftOptions]):
    """SIFT in every frame, matched to the landmarks of the target and initial views."""

    Options: ClassVar[type[StrictModel]] = SiftOptions

    def _begin(self, picture: Picture, landmarks: Landmarks) -> None:
        """Nothing to remember."""

    def _measure(self, picture: Picture, stamp: float) -> Views:
        assert self._landmarks is not None
        sigma = _SIGMA_PX / self.canvas.scale
        described = self._describe(picture.image)
        found = recognise(described, self._landmarks, self.canvas, sigma, self.context.seed)
        if found is None:
            return self._nothing(stamp, "too few features look like those of the target")
        return self._views(found.which, found.points, sigma, stamp)
