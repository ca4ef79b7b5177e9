"""Tracks held to the fixed views, where their patches are recognised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.perception.landmarks import ALIKE, Landmarks
from visctrl.perception.patch_alignment import Source

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: A patch found farther (px) than this from where it was expected is another one.
REACH_PX = 2.5
# Patches stretched by more than this, either way, are not compared.
_MAX_STRETCH = 2.5
# Calls after which both views are asked, not only the one that says more.
_ASK_BOTH = 3


@dataclass(frozen=True)
class Anchored:
    """Points after alignment; ``held`` (M,) tells which found a patch of a fixed view."""

    points: Array
    held: Mask


class TemplateAlignment:
    """Aligns tracks on the patches of both fixed views, and remembers how these are warped.

    A track takes the place between the two that their likeness suggests: at the start the
    initial view's, at the end the target's, so that whichever pair of views is nearly the same
    agrees to a hundredth of a pixel, and no drift builds up in between.
    """

    def __init__(self, landmarks: Landmarks) -> None:
        self._map = landmarks.map
        self._patches = landmarks.patches
        # Of each patch; of each view and landmark; how far to the right and below the initial
        # view's place for a landmark the target view's is.
        self._warps = np.zeros((2 * len(landmarks), 2, 2))
        self._weights = np.zeros((2, len(landmarks)))
        self._apart = np.zeros((len(landmarks), 2))
        self._calls = 0
        self.expect(np.arange(len(landmarks)), self._map.initial_pose)

    @property
    def disagreement(self) -> Array:
        """How far (px) to the side the fixed views put each landmark apart; 0 if not known yet.

        Patches of what is not quite the same point, or not flat, agree in one place only.
        """
        return np.abs(self._apart[:, 0])

    def expect(self, which: Indices, pose: Array) -> Array:
        """Set the warps that a pose of the current view suggests; return the rays expected."""
        rays, scale = self._map.predict(which, pose)
        _, initially = self._map.predict(which, self._map.initial_pose)
        self._warps[which] = np.eye(2) * scale[:, None, None]
        self._warps[len(self._map) + which] = np.eye(2) * (scale / initially)[:, None, None]
        self._weights[:, which] = 0.0
        return rays

    def hold(self, source: Source, which: Indices, points: Array, iterations: int) -> Anchored:
        """Align landmarks (M,) expected at points (M, 2) of an image.

        The view that said less about a landmark is asked about it again only once in a while; in
        between it is taken to differ from the other as it did then.
        """
        weight, apart = self._weights[:, which], self._apart[which]
        asked = (weight >= weight[::-1]) | ((which + self._calls) % _ASK_BOTH == 0)
        self._calls += 1
        view, track = np.nonzero(asked)
        number, start = view * len(self._map) + which[track], points[track]
        found = self._patches.align(source, number, start, self._warps[number], iterations)
        moved = np.linalg.norm(found.points - start, axis=-1)
        good = (found.score > ALIKE) & (moved < REACH_PX) & _sane(found.warps)
        self._warps[number[good]] = found.warps[good]
        told, place = np.zeros_like(asked), np.zeros((*asked.shape, 2))
        told[view, track], place[view, track] = good, found.points
        weight[view, track] = np.where(good, 1.0 / (1.02 - found.score) ** 3, 0.0)
        held, both = told.any(axis=0), told.all(axis=0)
        apart[both] = place[0, both] - place[1, both]
        self._weights[:, which], self._apart[which] = weight, apart
        by_target = np.where(told[0, :, None], place[0], place[1] + apart)
        share = weight[1] / np.where(held, weight.sum(axis=0), 1.0)
        return Anchored(np.where(held[:, None], by_target - share[:, None] * apart, points), held)


def _sane(warps: Array) -> Mask:
    """Return whether warps (M, 2, 2) neither stretch, squash nor mirror a patch too much."""
    # The sum of the squared singular values, and their product.
    square = (warps**2).sum(axis=(1, 2))
    product = warps[:, 0, 0] * warps[:, 1, 1] - warps[:, 0, 1] * warps[:, 1, 0]
    root = np.sqrt(np.maximum(square**2 - 4.0 * product**2, 0.0))
    largest, smallest = np.sqrt((square + root) / 2.0), np.sqrt(np.maximum(square - root, 0) / 2.0)
    return np.asarray((product > 0.0) & (largest < _MAX_STRETCH) & (smallest > 1.0 / _MAX_STRETCH))
