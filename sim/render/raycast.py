"""Textured rectangles as the rays of a camera meet them, and where in the image to look for each.

A ray d from the eye meets the plane of a rectangle whose upper left corner lies at C from the
eye, with edges R to the right and D down, where t d = C + a R + b D. With w = 1/t this is linear:

    (w, a w, b w) = [C R D]⁻¹ d

Three products tell whether a ray hits, where and how far away: 0 ≤ a w, b w ≤ w, and the nearest
hit has the largest w. A straight line in space stays the zero of a linear form, whatever curve
the camera makes of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visctrl.sim.render.surfaces import Rectangle

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: Nearer to its plane (m), the eye does not see a rectangle.
_EDGE_ON_M = 1e-4
#: Bounds are kept by this much more than rounding needs, so that nothing falls between tiles.
_SLACK = 1e-5


class Seen(NamedTuple):
    """The rectangles that show an eye their front.

    numbers : (N,) which ones.
    maps : (N, 3, 3) [C R D]⁻¹ for rays in camera axes.
    distance : (N,) of the eye from each plane (m).
    """

    numbers: Indices
    maps: Array
    distance: Array


class RectangleSet:
    """Rectangles that can be looked at from anywhere, and moved."""

    def __init__(self, rectangles: Sequence[Rectangle]) -> None:
        self._home = np.array([[r.corner + r.up, r.right, -r.up] for r in rectangles])
        self._now = self._home.copy()

    def move(self, which: Indices, rotation: Array, shift: Array) -> None:
        """Put some of them where ``rotation`` (3, 3) and ``shift`` (3,) take their first place."""
        self._now[which] = self._home[which] @ rotation.T
        self._now[which, 0] += shift

    def seen_from(self, eye: Array, axes: Array) -> Seen:
        """Return what an eye at (3,) sees, for rays along the camera's ``axes`` (3, 3 columns)."""
        frames = self._now.copy()
        frames[:, 0] -= eye
        corner, right, down = frames[:, 0], frames[:, 1], frames[:, 2]
        normal = np.cross(down, right)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        distance = -np.einsum("ij,ij->i", corner, normal)
        numbers = np.flatnonzero(distance > _EDGE_ON_M)
        # The frames hold C, R, D as rows.
        maps = np.swapaxes(np.linalg.inv(frames[numbers]), -1, -2) @ axes
        return Seen(numbers, maps, distance[numbers])


class Candidates(NamedTuple):
    """Which rectangles each of T tiles may show.

    counts : (T,) how many in each tile.
    which : (sum of counts,) indices into what is seen, tile by tile.
    filled : (T,) whether one of them fills the tile.
    """

    counts: Indices
    which: Indices
    filled: Mask


class Tiles(NamedTuple):
    """Square parts of an image, those without any valid ray left out.

    side : of each (px).
    corner : (T, 2) column and row of the first pixel.
    axis : (T, 3) mean of the tile's rays.
    reach : (T,) largest distance of one of its unit rays from the mean.
    """

    side: int
    corner: NDArray[np.int32]
    axis: Single
    reach: Single

    def gather(self, values: Array) -> Array:
        """Return values (H, W, K) of the image as (T, side, side, K), zeros beyond its edges."""
        columns = -(-values.shape[1] // self.side)
        column, row = (self.corner // self.side).T
        return np.asarray(_in_tiles(values, self.side)[row * columns + column])

    def candidates(self, seen: Seen) -> Candidates:
        """Return which rectangles each tile may show.

        A rectangle is left out where none of the tile's rays hits it, or another one lies
        before it in the whole tile.
        """
        w, p, q = seen.maps[:, 0], seen.maps[:, 1], seen.maps[:, 2]
        sides = np.stack([w, p, w - p, q, w - q])
        sides /= np.linalg.norm(sides, axis=-1, keepdims=True)
        # How far inside of each side the tile's mean ray is: (5, rectangles, tiles), the least.
        inside = (sides.astype(np.float32) @ self.axis.T).min(axis=0)
        reach = self.reach + np.float32(_SLACK)
        some = np.flatnonzero((inside >= -reach).any(axis=1))
        inside, w = inside[some], w[some].astype(np.float32)
        nearness = w @ self.axis.T
        spread = np.linalg.norm(w, axis=-1)[:, None] * reach
        # How near, at its farthest, the nearest rectangle is that fills the tile.
        full = np.where(inside >= reach, nearness - spread, 0.0).max(axis=0, initial=0.0)
        shown = (inside >= -reach) & (nearness + spread >= full)
        which = some[np.nonzero(shown.T)[1]]
        return Candidates(np.count_nonzero(shown, axis=0), which, full > 0.0)


def cut_tiles(rays: Array, valid: Mask, side: int) -> Tiles:
    """Cut an image with unit rays (H, W, 3), and whether they count (H, W), into square tiles."""
    weight = _in_tiles(valid[..., None].astype(np.float64), side)
    directions = _in_tiles(np.where(valid[..., None], rays, 0.0), side)
    used = np.flatnonzero(weight.any(axis=(1, 2, 3)))
    weight, directions = weight[used], directions[used]
    axis = directions.sum(axis=(1, 2)) / weight.sum(axis=(1, 2))
    away = np.linalg.norm(directions - axis[:, None, None], axis=-1)
    reach = np.where(weight[..., 0] > 0.0, away, 0.0).max(axis=(1, 2))
    columns = -(-valid.shape[1] // side)
    corner = side * np.stack([used % columns, used // columns], axis=-1)
    return Tiles(side, corner.astype(np.int32), axis.astype(np.float32), reach.astype(np.float32))


def _in_tiles(values: Array, side: int) -> Array:
    """Return values (H, W, K) as (tiles, side, side, K), row by row, zeros beyond the edges."""
    height, width, depth = values.shape
    rows, columns = -(-height // side), -(-width // side)
    padded = np.pad(values, ((0, rows * side - height), (0, columns * side - width), (0, 0)))
    blocks = padded.reshape(rows, side, columns, side, depth).swapaxes(1, 2)
    return blocks.reshape(rows * columns, side, side, depth)
