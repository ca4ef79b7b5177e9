"""The features that the target and the initial view share: what can be tracked at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.robust.scale import mad_sd
from visctrl.geometry.two_view.planar import PlanarMotion, refine_planar_motion, sampson_residuals
from visctrl.hal.cameras.central import CentralCamera
from visctrl.perception.ambiguity import Evidence, weigh
from visctrl.perception.matching import Described, mutual_matches, planar_inliers
from visctrl.perception.patch_alignment import Patches, Source
from visctrl.perception.pictures import Picture
from visctrl.perception.three_view import Resection, ThreeViewMap
from visctrl.perception.unwrap import Canvas

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: Correlation from which two patches count as the same piece of the world.
ALIKE = 0.8
# Standard deviation of a position after alignment (px), and what SIFT may be off by.
_ALIGNED_SIGMA_PX = 0.2
_MAX_CORRECTION_PX = 3.0
# Step (px) at which that alignment, done once for the whole run, ends.
_SETTLED_PX = 0.005
_GATE_SIGMAS = 4.0


@dataclass(frozen=True)
class Landmarks:
    """N features seen in the target and in the initial view.

    Their numbers 0 … N − 1 are their names. Positions are canvas points; in both views they
    mean the centre of the same patch.
    """

    target: Described
    initial: Described
    #: The target view's patches, then the initial view's.
    patches: Patches
    map: ThreeViewMap
    #: (N,) correlation of the two views' patches.
    likeness: Array

    def __len__(self) -> int:
        return len(self.target)


@dataclass(frozen=True)
class Recognised:
    """Landmarks found in a picture without knowing where it was taken.

    which : (M,) numbers of the landmarks; points : (M, 2) canvas points; fit : the pose.
    """

    which: Indices
    points: Array
    fit: Resection


@dataclass(frozen=True)
class Shared:
    """The outcome of matching two views: candidates, and the landmarks if there are enough.

    evidence : what speaks for and against them.
    """

    candidates: int
    inliers: int
    landmarks: Landmarks | None = None
    evidence: Evidence | None = None


def find_landmarks(
    target: tuple[Picture, Described],
    initial: tuple[Picture, Described],
    canvas: Canvas,
    camera: CentralCamera,
    minimum: int,
    seed: int,
) -> Shared:
    """Match the target with the initial view and keep what one planar motion explains.

    The initial positions are then aligned on the target's patches, to a tenth of a pixel where
    the two look alike, and judged once more. Whether another motion explains as much is weighed.
    """
    (_, a), (_, b) = target, initial
    at_target, at_start = (Source(view.frame, canvas.pixels) for view, _ in (target, initial))
    first, second = mutual_matches(a, b)
    a, b = a.subset(first), b.subset(second)
    motion = planar_inliers(a.rays, b.rays, canvas, seed)
    kept = motion.inliers
    if kept.sum() < minimum:
        return Shared(len(first), int(kept.sum()))
    pairs = first[kept], second[kept]
    a, b = a.subset(kept), b.subset(kept)
    patches = Patches((at_target, a.points))
    warps = np.eye(2) * (b.sizes / a.sizes)[:, None, None]
    found = patches.align(at_start, np.arange(len(a)), b.points, warps, 12, _SETTLED_PX)
    moved = np.linalg.norm(found.points - b.points, axis=-1)
    good = (found.score > ALIKE) & (moved < _MAX_CORRECTION_PX)
    points = np.where(good[:, None], found.points, b.points)
    b = Described(points, canvas.rays(points), b.sizes, b.descriptors)
    motion, agree = _refined(a.rays, b.rays, motion, good, _ALIGNED_SIGMA_PX / canvas.scale)
    if agree.sum() < minimum:
        return Shared(len(first), int(agree.sum()))
    evidence = weigh(
        target,
        initial,
        (first, second),
        (pairs[0][agree], pairs[1][agree]),
        points[agree],
        good[agree],
        motion,
        canvas,
        camera,
        seed,
    )
    a, b = a.subset(agree), b.subset(agree)
    landmarks = Landmarks(
        a,
        b,
        Patches((at_target, a.points), (at_start, b.points)),
        ThreeViewMap(a.rays, b.rays, motion, _ALIGNED_SIGMA_PX / canvas.scale),
        np.where(good, found.score, 0.0)[agree],
    )
    return Shared(len(first), int(agree.sum()), landmarks, evidence)


def recognise(
    picture: Described, landmarks: Landmarks, canvas: Canvas, sigma: float, seed: int
) -> Recognised | None:
    """Find landmarks in a described picture, by the looks they have in either fixed view.

    Returns
    -------
    None if too few agree with one planar motion from the target view.
    """
    best: dict[int, int] = {}
    for view in (landmarks.initial, landmarks.target):
        which, where = mutual_matches(view, picture)
        best.update(zip(which.tolist(), where.tolist(), strict=True))
    which = np.array(sorted(best), dtype=np.intp)
    where = np.array([best[i] for i in which.tolist()], dtype=np.intp)
    rays = picture.rays[where]
    motion = planar_inliers(landmarks.target.rays[which], rays, canvas, seed)
    kept = motion.inliers
    if not kept.any():
        return None
    which, where, rays = which[kept], where[kept], rays[kept]
    fit = landmarks.map.locate(which, rays, motion, sigma)
    agree = fit.inliers
    fit = Resection(fit.pose, fit.inliers[agree], fit.residual_sd)
    return Recognised(which[agree], picture.points[where[agree]], fit)


def _refined(
    a: Array, b: Array, motion: PlanarMotion, good: Mask, sigma: float
) -> tuple[PlanarMotion, Mask]:
    """Refine the motion on the aligned features, and judge all by it."""
    sure = good if good.sum() >= 10 else np.ones_like(good)
    motion = refine_planar_motion(a[sure], b[sure], motion.phi, motion.direction, sigma)
    residual, _ = sampson_residuals(a, b, motion.phi, motion.direction)
    # Two views' noise, and a tilt of the robot between them.
    limit = _GATE_SIGMAS * max(2.0 * sigma, mad_sd(residual))
    return motion, np.abs(residual) < limit
