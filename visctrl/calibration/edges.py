"""Straight edges in images, each measured along its whole length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.robust.scale import mad_sd

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Grey = NDArray[np.uint8]
#: Middle, direction, length and sigma, as in `Segments`.
Edge = tuple[Array, Array, float, float]

#: Shorter segments say little about a point far off (px).
_SEED_PX, _LEAST_LENGTH_PX = 14.0, 30.0
#: How far across an edge its place is looked for, and in what steps (px).
_REACH_PX, _STEP_PX = 3.0, 0.25
#: How far an edge is followed beyond its ends in one go, and across which gap (px).
_GROWTH_PX, _GAP_PX = 40.0, 4
_ROUNDS = 3
#: A place belongs to an edge if its contrast is this share of the edge's, at least.
_CONTRAST = 0.4
#: Standard deviation of an edge point across its line, at least (px), and how many
#: neighbouring points err together.
_LEAST_SIGMA_PX, _CORRELATED = 0.15, 4.0
#: What an ideal line bends by (px).
_MODEL_SIGMA_PX = 0.6
#: Scales at which edges are looked for: fine ones, and those that texture breaks up.
_SCALES = (0.8, 0.4)


@dataclass(frozen=True)
class Segments:
    """N straight edges in one or several images.

    middle, along : (N, 2) centre of its points (px) and unit direction.
    length : (N,) (px); sigma : (N,) standard deviation of the middle across the line (px).
    """

    middle: Array
    along: Array
    length: Array
    sigma: Array

    def __len__(self) -> int:
        return len(self.length)

    def subset(self, which: Mask) -> Segments:
        """Return some of the segments."""
        return Segments(
            self.middle[which], self.along[which], self.length[which], self.sigma[which]
        )

    @staticmethod
    def joined(parts: Sequence[Segments]) -> Segments:
        """Return the segments of several images as one set."""
        return Segments(
            np.concatenate([part.middle for part in parts]),
            np.concatenate([part.along for part in parts]),
            np.concatenate([part.length for part in parts]),
            np.concatenate([part.sigma for part in parts]),
        )

    def misses(self, points: Array) -> tuple[Array, Array]:
        """Return by how much lines miss points (M, 2), and the standard deviations of that.

        Both (M, N), in px. A point far from a short segment is missed easily: its direction is
        known to √12 σ / length.
        """
        towards = points[:, None] - self.middle
        miss = towards[..., 0] * self.along[:, 1] - towards[..., 1] * self.along[:, 0]
        lever = (towards * self.along).sum(axis=-1) / self.length
        sigma = self.sigma * np.sqrt(1.0 + 12.0 * lever**2)
        return miss, np.hypot(sigma, _MODEL_SIGMA_PX)


def find_segments(image: Grey) -> Segments:
    """Return the straight edges of a grey image, each once."""
    seeds = []
    for scale in _SCALES:
        found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, scale).detect(image)[0]
        if found is not None:
            seeds.append(np.asarray(found, np.float64).reshape(-1, 4))
    ends = np.concatenate(seeds) if seeds else np.zeros((0, 4))
    smooth = np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), dtype=np.float32)
    edges = [
        edge
        for a, b in zip(ends[:, :2], ends[:, 2:], strict=True)
        if np.linalg.norm(b - a) >= _SEED_PX and (edge := _measured(smooth, a, b)) is not None
    ]
    edges.sort(key=lambda edge: -edge[2])
    return _distinct(edges)


def _measured(image: NDArray[np.float32], a: Array, b: Array) -> Edge | None:
    """Return middle, direction, length and sigma of the edge that the segment ab lies on.

    None where there is no edge that goes on straight.
    """
    middle, span = (a + b) / 2.0, b - a
    length = float(np.linalg.norm(span))
    along = span / length
    sigma = 1.0
    for _ in range(_ROUNDS):
        half = length / 2.0 + _GROWTH_PX
        t = np.arange(-half, half + 0.5)
        offset, contrast = _profile(image, middle, along, t)
        known = np.abs(t) <= length / 2.0
        typical = float(np.median(contrast[known]))
        # The sign of the contrast is the segment's own, so that a bar's other side is not it.
        good = (contrast * np.sign(typical) > _CONTRAST * abs(typical)) & np.isfinite(offset)
        good = _connected(good, int(np.argmin(np.abs(t))))
        if good.sum() < _LEAST_LENGTH_PX / 2:
            return None
        normal = np.array([-along[1], along[0]])
        points = middle + t[good, None] * along + offset[good, None] * normal
        middle, along, length, sigma = _line(points, along)
    return (middle, along, length, sigma) if length >= _LEAST_LENGTH_PX else None


def _profile(
    image: NDArray[np.float32], middle: Array, along: Array, t: Array
) -> tuple[Array, Array]:
    """Return where across the line the contrast is greatest, and how great, along t (T,)."""
    normal = np.array([-along[1], along[0]])
    s = np.arange(-_REACH_PX - 1.0, _REACH_PX + 1.0 + _STEP_PX / 2, _STEP_PX)
    places = middle + t[:, None, None] * along + s[:, None] * normal
    x, y = (np.ascontiguousarray(places[..., k], dtype=np.float32) for k in (0, 1))
    values = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    lag = round(1.0 / _STEP_PX)
    slope = np.asarray(values[:, lag:] - values[:, :-lag], dtype=np.float64)
    centre = (s[lag:] + s[:-lag]) / 2.0
    sign = np.sign(np.median(slope[:, np.abs(centre) < 1.0].sum(axis=1)))
    peak = np.clip(np.argmax(sign * slope, axis=1), 1, slope.shape[1] - 2)
    rows = np.arange(len(t))
    before, at, after = (slope[rows, peak + k] for k in (-1, 0, 1))
    bend = before - 2.0 * at + after
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = 0.5 * (before - after) / bend
    offset = centre[peak] + np.where(np.abs(shift) <= 1.0, shift, 0.0) * _STEP_PX
    offset[np.abs(offset) > _REACH_PX - 0.5] = np.nan
    return offset, at


def _connected(good: Mask, start: int) -> Mask:
    """Return the part of a mask around ``start`` that has no long gap."""
    kept = np.zeros_like(good)
    for step in (1, -1):
        missing, i = 0, start
        while 0 <= i < len(good) and missing <= _GAP_PX:
            missing = 0 if good[i] else missing + 1
            kept[i] = good[i]
            i += step
    return kept


def _line(points: Array, before: Array) -> Edge:
    """Return middle, direction, length and sigma of the line through points (N, 2)."""
    kept = np.ones(len(points), dtype=bool)
    for _ in range(3):
        middle = points[kept].mean(axis=0)
        along = np.linalg.svd(points[kept] - middle, full_matrices=False)[2][0]
        across = (points - middle) @ np.array([-along[1], along[0]])
        spread = mad_sd(across[kept])
        kept = np.abs(across) < max(3.0 * spread, 0.3)
    along = along if along @ before > 0.0 else -along
    t = (points[kept] - middle) @ along
    count = max(1.0, kept.sum() / _CORRELATED)
    deviation = max(_LEAST_SIGMA_PX, float(across[kept].std()))
    # A uniform stretch of points with the same scatter.
    length = float(np.sqrt(12.0) * t.std())
    return middle, along, length, deviation / np.sqrt(count)


def _distinct(edges: Sequence[Edge]) -> Segments:
    """Return edges, longest first, without those that have grown onto another."""
    kept: list[Edge] = []
    for edge in edges:
        middle, along, _, _ = edge
        for other, direction, length, _ in kept:
            apart = middle - other
            near = abs(apart[0] * direction[1] - apart[1] * direction[0]) < 1.5
            if near and abs(apart @ direction) < length / 2 and abs(along @ direction) > 0.99:
                break
        else:
            kept.append(edge)
    return Segments(
        np.array([edge[0] for edge in kept]).reshape(-1, 2),
        np.array([edge[1] for edge in kept]).reshape(-1, 2),
        np.array([edge[2] for edge in kept]),
        np.array([edge[3] for edge in kept]),
    )
