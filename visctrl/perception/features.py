"""Perception for cameras that deliver identified features: matching is by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from visctrl.contracts import Array, Context, Health, Match, Perception, Views
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Features, Frame
from visctrl.robots.documents import StrictModel
from visctrl.robots.errors import InputError

Ids = NDArray[np.int64]
Mask = NDArray[np.bool_]


class FeaturesOptions(StrictModel):
    """Options of `IdentifiedFeatures`.

    noise_px : standard deviation of a feature's position that the robot counts on.
    min_features : fewer than this in common with the target and initial views are no view.
    """

    noise_px: Annotated[float, Field(gt=0.0)] = 0.5
    min_features: Annotated[int, Field(ge=3)] = 8


class IdentifiedFeatures(Perception[FeaturesOptions]):
    """Takes features as the camera names them and turns them into rays.

    Several target frames are averaged, feature by feature.
    """

    Options: ClassVar[type[FeaturesOptions]] = FeaturesOptions

    def __init__(self, options: FeaturesOptions, context: Context) -> None:
        super().__init__(options, context)
        self._camera = context.camera
        self._target = _Seen.nothing()
        self._target_sigmas = np.empty(0)
        self._fixed = _Fixed(_Seen.nothing(), _Seen.nothing(), np.empty((2, 0)))
        self._sigma = 0.0

    def set_target(self, frames: Sequence[Frame]) -> None:
        """Take the mean position of each feature that most frames show (see the contract)."""
        features = [_features_of(frame) for frame in frames]
        ids = np.concatenate([each.ids for each in features])
        pixels = np.concatenate([each.pixels for each in features])
        names, index, count = np.unique(ids, return_inverse=True, return_counts=True)
        mean = np.zeros((len(names), 2))
        np.add.at(mean, index, pixels)
        mean /= count[:, None]
        often = 2 * count > len(features)
        noise = self.options.noise_px / np.sqrt(count[often])
        self._target, valid = _Seen.of(Features(names[often], mean[often]), self._camera)
        self._require(len(self._target.ids), "the target view shows")
        per_pixel = self._camera.bearing_per_pixel(self._target.rays)
        self._target_sigmas = noise[valid] * per_pixel
        self._sigma = self.options.noise_px * float(np.median(per_pixel))

    def set_initial(self, frame: Frame) -> Match:
        """Take the features that this view and the target's have in common."""
        initial, _ = _Seen.of(_features_of(frame), self._camera)
        _, in_target, here = np.intersect1d(
            self._target.ids, initial.ids, assume_unique=True, return_indices=True
        )
        self._require(len(here), "the target is not recognised from here: it shares")
        target = self._target.at(in_target)
        initial = initial if len(here) == len(initial.ids) else initial.at(here)
        sigmas = np.stack([self._target_sigmas[in_target], self._sigmas(initial.rays)])
        self._fixed = _Fixed(target, initial, sigmas)
        return Match(
            candidates=len(here),
            inliers=len(here),
            target_pixels=target.pixels,
            initial_pixels=initial.pixels,
        )

    def update(self, frame: Frame) -> Views:
        """Return the features that all three views show."""
        current, _ = _Seen.of(_features_of(frame), self._camera)
        fixed = self._fixed
        same = current.ids is fixed.initial.ids or np.array_equal(current.ids, fixed.initial.ids)
        if not same:
            _, common, here = np.intersect1d(
                fixed.initial.ids, current.ids, assume_unique=True, return_indices=True
            )
            current, fixed = current.at(here), fixed.at(common)
        count = len(current.ids)
        lost = count < self.options.min_features
        return Views(
            ids=current.ids,
            target=fixed.target.rays,
            initial=fixed.initial.rays,
            current=current.rays,
            pixels=current.pixels,
            sigma=self._sigma,
            stamp=frame.stamp,
            health=Health.LOST if lost else Health.OK,
            reason=f"{count} features of {self.options.min_features} needed" if lost else "",
            sigmas=lambda: np.vstack([fixed.sigmas, self._sigmas(current.rays)]),
        )

    def _sigmas(self, rays: Array) -> Array:
        """Return the standard deviations (N,) of the bearings of rays of one frame."""
        return self.options.noise_px * self._camera.bearing_per_pixel(rays)

    def _require(self, count: int, what: str) -> None:
        if count < self.options.min_features:
            raise InputError(f"{what} {count} features, {self.options.min_features} are needed")


class _Seen(NamedTuple):
    """Features of one view with their rays, those without a ray left out."""

    ids: Ids
    pixels: Array
    rays: Array

    @classmethod
    def nothing(cls) -> _Seen:
        return cls(np.empty(0, dtype=np.int64), np.empty((0, 2)), np.empty((0, 3)))

    @classmethod
    def of(cls, features: Features, camera: CentralCamera) -> tuple[_Seen, Mask]:
        """Return what is seen, and which features (N,) that are."""
        rays, valid = camera.robot_rays(features.pixels)
        seen = cls(features.ids, features.pixels, rays)
        return (seen if valid.all() else seen.at(np.flatnonzero(valid))), valid

    def at(self, index: NDArray[np.intp]) -> _Seen:
        return _Seen(self.ids[index], self.pixels[index], self.rays[index])


class _Fixed(NamedTuple):
    """The features that target and initial view have in common.

    sigmas : (2, N) standard deviations of their bearings there (rad).
    """

    target: _Seen
    initial: _Seen
    sigmas: Array

    def at(self, index: NDArray[np.intp]) -> _Fixed:
        return _Fixed(self.target.at(index), self.initial.at(index), self.sigmas[:, index])


def _features_of(frame: Frame) -> Features:
    if frame.features is None:
        raise InputError(
            "perception 'features' needs a camera that delivers identified features (the mock's); "
            "images need perception 'klt'"
        )
    return frame.features
