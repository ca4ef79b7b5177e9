"""Tracks held to the fixed views, where their patches are recognised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.perception.landmarks import ALIKE, Landmarks
from visctrl.perception.patches import Source

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: A patch found farther (px) than this from where it was expected is another one.
REACH_PX = 2.5
# Patches stretched by more than this, either way, are not compared.
_MAX_STRETCH = 2.5
# A view that weighs less than this against the other is left out, but asked again this often (a
# prime, as a tick may call more than once).
_WORTH, _ASK_AGAIN = 0.03, 7


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
        self._map = landmarks.map
        self._patches = landmarks.patches
        # Of each patch; the weights by views.
        self._warps = np.zeros((2 * len(landmarks), 2, 2))
        self._weights = np.zeros((2, len(landmarks)))
        self._calls = 0
        self.expect(np.arange(len(landmarks)), self._map.initial_pose)

    def expect(self, which: Indices, pose: Array) -> Array:
        """Set the warps that a pose of the current view suggests; return the rays expected."""
        rays, scale = self._map.predict(which, pose)
        _, initially = self._map.predict(which, self._map.initial_pose)
        self._warps[which] = np.eye(2) * scale[:, None, None]
        self._warps[len(self._map) + which] = np.eye(2) * (scale / initially)[:, None, None]
        return rays

    def hold(self, source: Source, which: Indices, points: Array, iterations: int) -> Anchored:
        """Align landmarks (M,) expected at points (M, 2) of an image.

        The view that said next to nothing about a landmark is asked about it again only once in
        a while.
        """
        said = self._weights[:, which]
        due = (which + self._calls) % _ASK_AGAIN == 0
        self._calls += 1
        view, track = np.nonzero((said >= _WORTH * said[::-1]) | due)
        number, start = view * len(self._map) + which[track], points[track]
        found = self._patches.align(source, number, start, self._warps[number], iterations)
        moved = np.linalg.norm(found.points - start, axis=-1)
        good = (found.score > ALIKE) & (moved < REACH_PX) & _sane(found.warps)
        self._warps[number[good]] = found.warps[good]
        weight, place = np.zeros(said.shape), np.zeros((*said.shape, 2))
        weight[view, track] = np.where(good, 1.0 / (1.02 - found.score) ** 3, 0.0)
        place[view, track] = found.points
        self._weights.flat[number] = weight[view, track]
        total = weight.sum(axis=0)
        held = total > 0.0
        mean = (weight[..., None] * place).sum(axis=0) / np.where(held, total, 1.0)[:, None]
        return Anchored(np.where(held[:, None], mean, points), held)


def _sane(warps: Array) -> Mask:
    """Return whether warps (M, 2, 2) neither stretch, squash nor mirror a patch too much."""
    # The sum of the squared singular values, and their product.
    square = (warps**2).sum(axis=(1, 2))
    product = warps[:, 0, 0] * warps[:, 1, 1] - warps[:, 0, 1] * warps[:, 1, 0]
    root = np.sqrt(np.maximum(square**2 - 4.0 * product**2, 0.0))
    largest, smallest = np.sqrt((square + root) / 2.0), np.sqrt(np.maximum(square - root, 0) / 2.0)
    return np.asarray((product > 0.0) & (largest < _MAX_STRETCH) & (smallest > 1.0 / _MAX_STRETCH))
