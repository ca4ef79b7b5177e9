"""The target view as arrival is judged by where a camera names its features itself."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Features
from visctrl.schemes.arrival.comparison import Comparison, whitening
from visctrl.schemes.arrival.displacement import Array, Sighting

#: What a feature's position is off by (px) before the fit tells better; coincidence is judged
#: by so many times that.
NOISE_PX, _COINCIDES_SD = 0.5, 3.0

Ids = NDArray[np.int64]


class FeatureTarget:
    """The target's identified features: the mean of each that most frames show.

    Parameters
    ----------
    frames : sequence of Features
        One or several views from the target pose.
    camera : CentralCamera
        The calibration that the robot believes in.
    """

    def __init__(self, frames: Sequence[Features], camera: CentralCamera) -> None:
        self._camera = camera
        self.ids, self._pixels, self._count = _averaged(frames)
        self.rays, seen = camera.robot_rays(self._pixels)
        self.ids, self.rays = self.ids[seen], self.rays[seen]
        self._pixels = self._pixels[seen]
        self._whiten = whitening(camera, self._pixels, np.eye(2)[None])

    def __len__(self) -> int:
        return len(self.ids)

    def compare(self, frames: Sequence[Features], noise: float = 1.0) -> Comparison:
        """Pair the features with those of one or several frames of one pose, by their names.

        noise : what `NOISE_PX` is multiplied with.
        """
        ids, pixels, count = _averaged(frames)
        _, ours, theirs = np.intersect1d(self.ids, ids, assume_unique=True, return_indices=True)
        rays = np.full((len(self), 3), np.nan)
        found, seen = self._camera.robot_rays(pixels[theirs])
        rays[ours[seen]] = found[seen]
        sd = NOISE_PX * math.hypot(1.0 / math.sqrt(self._count), 1.0 / math.sqrt(count)) * noise
        away = np.full(len(self), np.inf)
        away[ours] = np.linalg.norm(pixels[theirs] - self._pixels[ours], axis=-1)
        return Comparison(
            ids=self.ids,
            target=self.rays,
            current=self.sighting(rays, sd),
            coincides=away < _COINCIDES_SD * sd,
            contrast=np.ones(len(self)),
        )

    def sighting(self, rays: Array, sd_px: float) -> Sighting:
        """Return rays (N, 3) of the features as a view whose positions are off by so much."""
        return Sighting(rays, self._whiten / sd_px)

    def at(self, ids: Ids, rays: Array) -> Array:
        """Return rays (N, 3) of all features from those (M, 3) of some; NaN for the others."""
        found = np.full((len(self), 3), np.nan)
        _, ours, theirs = np.intersect1d(self.ids, ids, assume_unique=True, return_indices=True)
        found[ours] = rays[theirs]
        return found


def _averaged(frames: Sequence[Features]) -> tuple[Ids, Array, int]:
    """Return names and mean positions of what most frames show, and the number of frames."""
    ids = np.concatenate([each.ids for each in frames])
    pixels = np.concatenate([each.pixels for each in frames])
    names, index, count = np.unique(ids, return_inverse=True, return_counts=True)
    mean = np.zeros((len(names), 2))
    np.add.at(mean, index, pixels)
    often = 2 * count > len(frames)
    return names[often], mean[often] / count[often, None], len(frames)
