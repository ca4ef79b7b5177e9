"""What the perceptions that find their own features have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Annotated, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from visctrl.contracts import Context, Health, Match, Perception, Views
from visctrl.hal.errors import InputError
from visctrl.hal.types import Frame
from visctrl.perception.ambiguity import AmbiguousMatchError
from visctrl.perception.landmarks import Landmarks, find_landmarks
from visctrl.perception.matching import Described, describe
from visctrl.perception.patch_alignment import HALF
from visctrl.perception.pictures import Picture, averaged, checked, draw
from visctrl.perception.unwrap import Canvas, canvas_for
from visctrl.robots.documents import StrictModel

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]
Indices = NDArray[np.intp]

#: Distance (px) that features keep from the edge of the field of view: half a patch and more.
MARGIN_PX = HALF + 3


class ImagePerceptionOptions(StrictModel):
    """Options of the perceptions that find their own features.

    keypoints : SIFT keypoints per image.
    min_matches : features that must agree between target and initial view.
    min_features : features below which a view counts as lost.
    accept_ambiguous : drive even where another place explains the start as well (see
        `visctrl.perception.ambiguity`).
    px_per_rad : resolution of the cylindrical unwrap; by default the camera's own.
    """

    keypoints: Annotated[int, Field(ge=50, le=5000)] = 2000
    min_matches: Annotated[int, Field(ge=8)] = 20
    min_features: Annotated[int, Field(ge=5)] = 10
    accept_ambiguous: bool = False
    px_per_rad: Annotated[float, Field(gt=20, le=2000)] | None = None


ImagePerceptionT = TypeVar("ImagePerceptionT", bound=ImagePerceptionOptions)


class ImagePerception(Perception[ImagePerceptionT]):
    """Takes the target and initial views, matches them, and sorts out unusable frames."""

    def __init__(self, options: ImagePerceptionT, context: Context) -> None:
        super().__init__(options, context)
        self.canvas: Canvas = canvas_for(context.camera, options.px_per_rad)
        self._target: tuple[Picture, Described] | None = None
        self._landmarks: Landmarks | None = None
        self._last: tuple[int, Views] | None = None
        self._calibration_doubtful = False

    def notes(self) -> Sequence[str]:
        """Say so if the camera seems to be calibrated wrongly."""
        if not self._calibration_doubtful:
            return ()
        return (
            "the first match fits another image centre, tilt or scale much better than the "
            "camera's calibration: check that with `visctrl calibrate`",
        )

    def set_target(self, frames: Sequence[Frame]) -> None:
        """Take the target view (see `Perception.set_target`)."""
        if not frames:
            raise InputError("no target image was given")
        images = [checked(frame, self.context.camera, "the target image") for frame in frames]
        picture = draw(averaged(images, self.canvas), self.canvas)
        if picture.blank:
            raise InputError(f"the target image {picture.complaint}")
        described = self._describe(picture.image)
        if len(described) < self.options.min_matches:
            raise InputError(
                f"the target image has {len(described)} features, {self.options.min_matches} are "
                "needed: choose a target that sees more texture, or sharpen and light it better"
            )
        self._target = picture, described
        self._landmarks = None

    def set_initial(self, frame: Frame) -> Match:
        """Take the initial view and match it to the target (see `Perception.set_initial`)."""
        if self._target is None:
            raise RuntimeError("set_target comes before set_initial")
        camera = self.context.camera
        picture = draw(checked(frame, camera, "the initial image"), self.canvas)
        if picture.blank:
            raise InputError(f"the initial image {picture.complaint}")
        initial = picture, self._describe(picture.image)
        needed = self.options.min_matches
        shared = find_landmarks(
            self._target, initial, self.canvas, camera, needed, self.context.seed
        )
        if shared.landmarks is None:
            raise InputError(
                f"target not recognised from the start: {shared.inliers} features agree, "
                f"{needed} needed ({shared.candidates} looked alike): start nearer to the "
                "target or facing it more, or check that the target shows this place"
            )
        evidence = shared.evidence
        assert evidence is not None
        if evidence.objection and not self.options.accept_ambiguous:
            raise AmbiguousMatchError(
                f"the start cannot be told for certain: {evidence.objection}", evidence.matched
            )
        self._calibration_doubtful |= evidence.calibration
        self._landmarks = shared.landmarks
        self._last = None
        self._begin(picture, shared.landmarks)
        return Match(
            shared.candidates,
            shared.inliers,
            camera.robot_pixels(shared.landmarks.target.rays)[0],
            camera.robot_pixels(shared.landmarks.initial.rays)[0],
            evidence.matched,
        )

    def update(self, frame: Frame) -> Views:
        """Return the features of a frame (see `Perception.update`)."""
        if self._landmarks is None:
            raise RuntimeError("set_initial comes before update")
        if self._last is not None and self._last[0] == frame.sequence:
            return self._last[1]
        image, camera = frame.image, self.context.camera
        if image is None or image.shape != (camera.height, camera.width):
            found = "no image" if image is None else f"an image of shape {image.shape}"
            views = self._nothing(frame.stamp, f"the camera delivered {found}")
        else:
            picture = draw(image, self.canvas)
            if picture.blank:
                views = self._nothing(frame.stamp, f"the image {picture.complaint}")
            else:
                views = self._measure(picture, frame.stamp)
        self._last = frame.sequence, views
        return views

    @abstractmethod
    def _begin(self, picture: Picture, landmarks: Landmarks) -> None:
        """Start anew from an initial view; everything of an earlier one is forgotten."""

    @abstractmethod
    def _measure(self, picture: Picture, stamp: float) -> Views:
        """Return the features of a picture that is not blank."""

    def _describe(self, image: Grey) -> Described:
        return describe(image, self.canvas, self.options.keypoints, MARGIN_PX)

    def _views(
        self,
        which: Indices,
        points: Array,
        sigma: float,
        stamp: float,
        doubts: Array | None = None,
    ) -> Views:
        """Return landmarks seen at canvas points, as views; too few of them are lost.

        doubts : of every landmark, what its bearings may be off besides (rad).
        """
        landmarks = self._landmarks
        assert landmarks is not None
        order = np.argsort(which)
        which, rays = which[order], self.canvas.rays(points[order])
        enough = len(which) >= self.options.min_features
        reason = f"{len(which)} features seen, {self.options.min_features} needed"
        doubt = None if doubts is None else doubts[which]
        return Views(
            ids=which.astype(np.int64),
            target=landmarks.target.rays[which],
            initial=landmarks.initial.rays[which],
            current=rays,
            pixels=self.context.camera.robot_pixels(rays)[0],
            sigma=sigma,
            stamp=stamp,
            health=Health.OK if enough else Health.LOST,
            reason="" if enough else reason,
            sigmas=None if doubt is None else lambda: np.tile(np.hypot(sigma, doubt), (3, 1)),
        )

    def _nothing(self, stamp: float, reason: str) -> Views:
        """Return views of nothing."""
        rays = np.zeros((0, 3))
        return Views(
            ids=np.zeros(0, dtype=np.int64),
            target=rays,
            initial=rays,
            current=rays,
            pixels=np.zeros((0, 2)),
            sigma=1.0 / self.canvas.scale,
            stamp=stamp,
            health=Health.LOST,
            reason=reason,
        )
