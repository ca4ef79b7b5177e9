"""Tracks held to the fixed views: where does the patch of the target, or of the start, lie now?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.perception.landmarks import ALIKE, Landmarks
from visctrl.perception.patches import Alignment, Patches, Values

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: A patch found farther (px) than this from where it was expected is another one.
REACH_PX = 2.5
# Patches stretched by more than this, either way, are not compared.
_MAX_STRETCH = 2.5


@dataclass(frozen=True)
class Anchored:
    """Points after alignment; ``held`` (M,) tells which found a patch of a fixed view."""

    points: Array
    held: Mask


class Anchors:
    """Aligns tracks on the patches of both fixed views, and remembers how these are warped.

    A track takes the place between the two that their likeness suggests: at the start the
    initial view's, at the end the target's, so that whichever pair of views is nearly the same
    agrees to a hundredth of a pixel, and no drift builds up in between.
    """

    def __init__(self, landmarks: Landmarks) -> None:
        self._landmarks = landmarks
        self._views = (landmarks.target_patches, landmarks.initial_patches)
        self._warps = np.zeros((2, len(landmarks), 2, 2))
        self.expect(np.arange(len(landmarks)), landmarks.map.initial_pose)

    def expect(self, which: Indices, pose: Array) -> Array:
        """Set the warps that a pose of the current view suggests; return the rays expected."""
        rays, scale = self._landmarks.map.predict(which, pose)
        _, initially = self._landmarks.map.predict(which, self._landmarks.map.initial_pose)
        self._warps[0, which] = np.eye(2) * scale[:, None, None]
        self._warps[1, which] = np.eye(2) * (scale / initially)[:, None, None]
        return rays

    def hold(self, image: Values, which: Indices, points: Array, iterations: int = 3) -> Anchored:
        """Align landmarks (M,) expected at points (M, 2) of an image (see `prepared`)."""
        total = np.zeros(len(which))
        place = np.zeros_like(points)
        for view, patches in enumerate(self._views):
            found, weight = self._align(view, patches, image, which, points, iterations)
            place += weight[:, None] * found.points
            total += weight
        held = total > 0.0
        return Anchored(
            np.where(held[:, None], place / np.maximum(total, 1e-12)[:, None], points), held
        )

    def _align(
        self,
        view: int,
        patches: Patches,
        image: Values,
        which: Indices,
        points: Array,
        iterations: int,
    ) -> tuple[Alignment, Array]:
        """Return the alignment on one view and its weights (M,), 0 where it is not trusted."""
        found = patches.align(image, which, points, self._warps[view, which], iterations)
        moved = np.linalg.norm(found.points - points, axis=-1)
        stretch = np.linalg.svd(found.warps, compute_uv=False)
        sane = (stretch[:, 0] < _MAX_STRETCH) & (stretch[:, 1] > 1.0 / _MAX_STRETCH)
        good = (found.score > ALIKE) & (moved < REACH_PX) & sane
        self._warps[view, which[good]] = found.warps[good]
        return found, np.where(good, 1.0 / (1.02 - found.score) ** 2, 0.0)
