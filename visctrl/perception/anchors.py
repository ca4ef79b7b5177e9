"""Tracks held to the fixed views, where their patches are recognised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.perception.landmarks import ALIKE, Landmarks
from visctrl.perception.patches import Values

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: A patch found farther (px) than this from where it was expected is another one.
REACH_PX = 2.5
# Patches stretched by more than this, either way, are not compared.
_MAX_STRETCH = 2.5
# A view that weighs less than this against the other is left out, but asked again this often.
_WORTH, _ASK_AGAIN = 0.1, 8


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
        self._weights = np.zeros((2, len(landmarks)))
        self._calls = 0
        self.expect(np.arange(len(landmarks)), landmarks.map.initial_pose)

    def expect(self, which: Indices, pose: Array) -> Array:
        """Set the warps that a pose of the current view suggests; return the rays expected."""
        rays, scale = self._landmarks.map.predict(which, pose)
        _, initially = self._landmarks.map.predict(which, self._landmarks.map.initial_pose)
        self._warps[0, which] = np.eye(2) * scale[:, None, None]
        self._warps[1, which] = np.eye(2) * (scale / initially)[:, None, None]
        return rays

    def hold(self, image: Values, which: Indices, points: Array, iterations: int) -> Anchored:
        """Align landmarks (M,) expected at points (M, 2) of an image (see `prepared`).

        The view that said next to nothing about a landmark is asked about it again only once in
        a while.
        """
        total = np.zeros(len(which))
        place = np.zeros_like(points)
        due = (which + self._calls) % _ASK_AGAIN == 0
        self._calls += 1
        worth = [self._weights[v, which] >= _WORTH * self._weights[1 - v, which] for v in (0, 1)]
        for view in (0, 1):
            asked = np.flatnonzero(worth[view] | due)
            found, weight = self._align(view, image, which[asked], points[asked], iterations)
            place[asked] += weight[:, None] * found
            total[asked] += weight
        held = total > 0.0
        place /= np.where(held, total, 1.0)[:, None]
        return Anchored(np.where(held[:, None], place, points), held)

    def _align(
        self,
        view: int,
        image: Values,
        which: Indices,
        points: Array,
        iterations: int,
    ) -> tuple[Array, Array]:
        """Return places (M, 2) by one view and their weights (M,), 0 where not to be trusted."""
        start = self._warps[view, which]
        found = self._views[view].align(image, which, points, start, iterations)
        moved = np.linalg.norm(found.points - points, axis=-1)
        good = (found.score > ALIKE) & (moved < REACH_PX) & _sane(found.warps)
        self._warps[view, which[good]] = found.warps[good]
        weights = np.where(good, 1.0 / (1.02 - found.score) ** 2, 0.0)
        self._weights[view, which] = weights
        return found.points, weights


def _sane(warps: Array) -> Mask:
    """Return whether warps (M, 2, 2) neither stretch, squash nor mirror a patch too much."""
    # The sum of the squared singular values, and their product.
    square = (warps**2).sum(axis=(1, 2))
    product = warps[:, 0, 0] * warps[:, 1, 1] - warps[:, 0, 1] * warps[:, 1, 0]
    root = np.sqrt(np.maximum(square**2 - 4.0 * product**2, 0.0))
    largest, smallest = np.sqrt((square + root) / 2.0), np.sqrt(np.maximum(square - root, 0) / 2.0)
    return np.asarray((product > 0.0) & (largest < _MAX_STRETCH) & (smallest > 1.0 / _MAX_STRETCH))
