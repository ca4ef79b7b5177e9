"""The arrival check: whether the picture is the target's, and what is left to drive.

At the target the current image is the target image, whatever the calibration, the wheels, the
delay or the law. The check knows nothing of what brought the robot here: it finds the target's
features again in the last picture and fits the displacement that their bearings show.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Health, Views
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Frame, Pose
from visctrl.schemes.arrival.comparison import Comparison
from visctrl.schemes.arrival.displacement import Displacement, displacement
from visctrl.schemes.arrival.feature_target import FeatureTarget
from visctrl.schemes.arrival.way import Passed, depths_on_the_way

if TYPE_CHECKING:
    from visctrl.schemes.arrival.image_target import ImageTarget

#: Features that a decision needs, and the share of the target's that must agree.
LEAST_FEATURES, LEAST_SHARE = 8, 0.3
#: A feature agrees with the fit within this (standard deviations of its own).
_AGREES = 4.0
#: Share that coincides below which the verdict says that not everything does.
_ALL = 0.9
#: Repeated patterns: the strong half of the features coincides, the weak half does not.
_STRONG, _WEAK = 0.9, 0.6
#: Standard deviations that a decision keeps off the tolerance.
SIGMAS = 2.0
#: What the camera's model and the alignment leave in common to all features (px).
_COMMON_PX = 0.01
#: What a calibration is off by, of the angles that it measures.
_CALIBRATION = 0.05


class Answer(StrEnum):
    """What the picture says."""

    THERE = "there"
    ELSEWHERE = "elsewhere"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class Verdict:
    """The arrival check's answer, with its numbers.

    reason : a sentence's end, for the summary.
    left : the remaining pose error; None where too little is found to say.
    found, agree, coincide : shares of the target's features that are found, that agree with the
        displacement, and that are where the target has them.
    features : number of the target's features.
    """

    answer: Answer
    reason: str
    left: Displacement | None
    found: float
    agree: float
    coincide: float
    features: int


@dataclass(frozen=True)
class Tolerance:
    """How close is there: position (m) and heading (rad)."""

    position: float
    heading: float


class ArrivalCheck:
    """Judges by the image whether a robot is at its target.

    Parameters
    ----------
    camera : CentralCamera
        The calibration that the robot believes in.
    height : float
        The camera's height over the floor (m).
    tolerance : Tolerance
        What counts as there.
    """

    def __init__(self, camera: CentralCamera, height: float, tolerance: Tolerance) -> None:
        self._camera = camera
        self._height = height
        self._tolerance = tolerance
        self._images: ImageTarget | None = None
        self._features: FeatureTarget | None = None
        self._passed: list[Passed] = []

    def set_target(self, frames: Sequence[Frame]) -> None:
        """Prepare the target from its frames: images, or else identified features."""
        images = [frame.image for frame in frames if frame.image is not None]
        named = [frame.features for frame in frames if frame.features is not None]
        if images:
            # Not needed, and not imported, where features come identified.
            from visctrl.schemes.arrival.image_target import ImageTarget

            self._images = ImageTarget(images, self._camera)
        elif named:
            self._features = FeatureTarget(named, self._camera)

    def set_initial(self, frame: Frame) -> None:
        """Take a picture from the start: what the robot itself shows in it is left out."""
        if self._images is not None and self._fits(frame):
            assert frame.image is not None
            self._images.leave_out_own(frame.image)

    def pass_by(self, views: Views, camera: Pose) -> None:
        """Remember a view on the way, and where the wheels say the camera was.

        The views tell how far the scene is, and of the end of the way nothing.
        """
        if views.health is not Health.LOST:
            self._passed.append(Passed(views, camera))

    def judge(self, frames: Sequence[Frame]) -> Verdict:
        """Compare one or several frames of a robot that stands with the target."""
        if self._images is not None:
            return self._judge_images(self._images, frames)
        if self._features is not None:
            return self._judge_features(self._features, frames)
        return _nothing("the target view has neither an image nor features", 0)

    def _judge_images(self, target: ImageTarget, frames: Sequence[Frame]) -> Verdict:
        image = frames[-1].image
        if image is None or not self._fits(frames[-1]):
            return _nothing("the camera delivers no picture to judge by", len(target))
        seen = target.compare(image)
        if seen.found < LEAST_FEATURES:
            return self._verdict(seen, None)
        depths = depths_on_the_way(self._passed).around(seen.target)
        depths = depths.with_floor(seen.target, self._height)
        return self._verdict(seen, displacement(seen.target, seen.current, depths))

    def _judge_features(self, target: FeatureTarget, frames: Sequence[Frame]) -> Verdict:
        named = [frame.features for frame in frames if frame.features is not None]
        if not named:
            return _nothing("the camera delivers no features to judge by", len(target))
        seen = target.compare(named)
        if seen.found < LEAST_FEATURES:
            return self._verdict(seen, None)
        left = displacement(seen.target, seen.current)
        # Their noise is not known: it is what the fit leaves.
        noise = float(np.clip(math.sqrt(left.excess), 1e-3, 20.0))
        seen = target.compare(named, noise)
        depths = depths_on_the_way(self._passed).of(target.ids)
        return self._verdict(seen, displacement(seen.target, seen.current, depths, left.pose))

    def _fits(self, frame: Frame) -> bool:
        """Return whether a frame's picture can be of this camera."""
        size = (self._camera.height, self._camera.width)
        return frame.image is not None and frame.image.shape == size

    def _verdict(self, seen: Comparison, left: Displacement | None) -> Verdict:
        count = len(seen.ids)
        found = seen.found / max(1, count)
        agreeing = np.zeros(count, dtype=np.bool_)
        if left is not None:
            left = self._with_common(left)
            agreeing = np.nan_to_num(left.residuals, nan=np.inf) < _AGREES
        agree = float(agreeing.mean()) if count else 0.0
        answer, reason = self._answer(seen, left, agreeing)
        return Verdict(answer, reason, left, found, agree, seen.share, count)

    def _answer(
        self, seen: Comparison, left: Displacement | None, agreeing: NDArray[np.bool_]
    ) -> tuple[Answer, str]:
        count = len(seen.ids)
        if count < LEAST_FEATURES:
            return Answer.UNDECIDED, f"the target has {count} features to judge by: too few"
        share = float(agreeing.mean())
        if left is None or share < LEAST_SHARE or agreeing.sum() < LEAST_FEATURES:
            return Answer.ELSEWHERE, f"{agreeing.sum()} of its {count} features are found here"
        where = describe(left)
        if self._outside(left):
            return Answer.ELSEWHERE, where
        if not self._inside(left):
            return Answer.UNDECIDED, f"{where}: too uncertain for the tolerance"
        if repeated := _repeated(seen, agreeing):
            return Answer.UNDECIDED, f"{where}, but {repeated}"
        part = f", {100.0 * share:.0f} % of the features coincide" if share < _ALL else ""
        return Answer.THERE, where + part

    def _inside(self, left: Displacement) -> bool:
        """Return whether the error is within tolerance, its doubt included."""
        heading = abs(left.pose.phi) + SIGMAS * left.heading_sd
        position = left.distance + SIGMAS * left.distance_sd
        return position <= self._tolerance.position and heading <= self._tolerance.heading

    def _outside(self, left: Displacement) -> bool:
        """Return whether the error is beyond tolerance, whatever its doubt."""
        heading = abs(left.pose.phi) - SIGMAS * left.heading_sd
        position = left.least_distance(SIGMAS)
        return position > self._tolerance.position or heading > self._tolerance.heading

    def _with_common(self, left: Displacement) -> Displacement:
        """Add to the covariance what averaging over the features does not take away.

        A calibration that is wrong tilts the directions of all features: some of a turn then
        passes for a translation, and the other way round.
        """
        ahead = float(self._camera.bearing_per_pixel(np.array([0.0, 1.0, 0.0])))
        alignment = _COMMON_PX * self._camera.width / 400.0 * ahead if self._images else 0.0
        turn, parallax = abs(left.pose.phi), left.distance * left.nearness
        position = _CALIBRATION * (turn + parallax) / left.nearness
        heading = math.hypot(alignment, _CALIBRATION * (0.3 * turn + parallax))
        common = np.diag([position**2, position**2, heading**2])
        return replace(left, by_noise=left.by_noise + common)


def describe(left: Displacement) -> str:
    """Return a displacement in words."""
    return (
        f"{100.0 * left.distance:.2f} ± {100.0 * left.distance_sd:.2f} cm and "
        f"{abs(math.degrees(left.pose.phi)):.2f} ± {math.degrees(left.heading_sd):.2f} deg left"
    )


def _repeated(seen: Comparison, agreeing: NDArray[np.bool_]) -> str:
    """Return what speaks for a repeated pattern; empty if nothing does.

    In a row of equal things the strong outlines coincide one period on, and the faint texture
    in between does not; where part of the scene has moved, both are shared out alike.
    """
    order = np.argsort(seen.contrast)
    half = len(order) // 2
    weak, strong = (float(agreeing[part].mean()) for part in (order[:half], order[half:]))
    if strong < _STRONG or weak >= _WEAK:
        return ""
    return (
        f"only the strong patterns coincide ({100.0 * strong:.0f} % of them, {100.0 * weak:.0f} % "
        "of the faint ones): this may be another place that looks alike"
    )


def _nothing(reason: str, features: int) -> Verdict:
    return Verdict(Answer.UNDECIDED, reason, None, 0.0, 0.0, 0.0, features)
