"""A second place from which a start's view of the target could have been taken.

In a room that repeats itself, features look like their neighbours, and a whole other motion may
explain as much as the one that was found. It is looked for among all pairs of features that look
alike, not only the best ones, and proved by the features' patches: what looks alike as a SIFT
descriptor by chance does not align to a fraction of a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.robust.sampling import Score, ransac
from visctrl.geometry.two_view.parallax import signed_parallax
from visctrl.geometry.two_view.planar import (
    PlanarMotion,
    refine_planar_motion,
    sampson_residuals,
    squared_residuals,
)
from visctrl.geometry.two_view.planar_2pt import two_point_motions
from visctrl.perception.matching import Described
from visctrl.perception.patch_alignment import Patches, Source
from visctrl.perception.unwrap import Canvas
from visctrl.robots.unicycle import wrap_angle

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: Pairs considered of each feature, and how unlike they may be: this share above the best one's
#: distance of descriptors, or this distance.
_NEAREST, _RATIO, _ALIKE_DISTANCE = 4, 1.25, 200.0
#: Two keypoints nearer than this are one (px).
_ONE_PX = 8.0
#: Pairs at most, hypotheses, and candidates whose patches are compared.
_PAIRS, _HYPOTHESES, _CANDIDATES = 3000, 1500, 6
_FEWEST_PAIRS, _FEWEST_ALIGNED = 10, 8
#: Residuals (px) of pairs that the found motion explains, and of those that a rival does.
_EXPLAINED_PX, _GATE_PX = 1.8, 1.2
#: Motions nearer than this are one: headings, and bearings of the baseline (rad).
_HEADING, _BEARING, _SIGMAS = math.radians(2.0), math.radians(8.0), 4.0
#: Residuals of features that certainly belong, in their own deviations; what patches of surfaces
#: that are not quite flat add to these (px).
SURE_SIGMAS, SURE_PX = 4.0, 0.06
_ALIKE, _MOST_CORRECTION_PX, _STEPS = 0.8, 3.0, 6
_SIGMA_PX = 0.2
#: Parallax below which rays meet behind the views (rad).
_BEHIND = -0.02


@dataclass(frozen=True)
class Rival:
    """Another motion, and the target features (numbers) that certainly agree with it.

    Only features that are distinctive in their pair are listed: which have no double in the
    target view itself.
    """

    motion: PlanarMotion
    features: Indices


def doubles(target: Described) -> Array:
    """Return the distance (N,) of each descriptor to the most similar one elsewhere in its view."""
    if len(target) < 2:
        return np.full(len(target), np.inf)
    distance = _distances(target, target)
    apart = np.linalg.norm(target.points[:, None] - target.points[None], axis=-1)
    return np.asarray(np.where(apart < _ONE_PX, np.inf, distance).min(axis=1))


def distinctive(double: Array, distance: Array) -> Mask:
    """Return whether features are told from their doubles by a pair's ``distance`` (N,)."""
    return np.asarray(double >= np.maximum(_RATIO * distance, _ALIKE_DISTANCE))


def find_rival(
    target: tuple[Source, Described],
    initial: tuple[Source, Described],
    motion: PlanarMotion,
    canvas: Canvas,
    deviations: Array,
    double: Array,
    seed: int,
) -> Rival | None:
    """Return the motion, other than ``motion``, that most distinctive features agree with.

    Parameters
    ----------
    target, initial : (Source, Described)
        Each view's image and its described features.
    motion : PlanarMotion
        What was found.
    canvas : Canvas
    deviations : (N,) standard deviations of the target features' positions (px)
    double : (N,) see `doubles`
    seed : int
        Of the random samples.
    """
    (at_target, a), (at_start, b) = target, initial
    pairs, distance = _pairs(a, b, motion, canvas)
    if len(pairs) < _FEWEST_PAIRS:
        return None
    best: Rival | None = None
    for angles, inliers in _candidates(a, b, pairs, distance, motion, canvas, seed):
        chosen = _one_each(pairs, distance, inliers)
        which, there, far = pairs[chosen, 0], pairs[chosen, 1], distance[chosen]
        aligned, points = _aligned(at_target, at_start, a.subset(which), b.subset(there))
        rays_a, rays_b = a.rays[which], canvas.rays(points)
        rival = _refined(rays_a, rays_b, angles, aligned, motion, canvas)
        if rival is None:
            continue
        sure = aligned & agreeing(rays_a, rays_b, rival, deviations[which], canvas)
        features = which[sure & distinctive(double[which], far)]
        if best is None or len(features) > len(best.features):
            best = Rival(rival, features)
    return best


def agreeing(
    rays_a: Array, rays_b: Array, motion: PlanarMotion, deviations: Array, canvas: Canvas
) -> Mask:
    """Return which features (N,) certainly agree with a motion, by their own deviations (px)."""
    residual, _ = sampson_residuals(rays_a, rays_b, motion.phi, motion.direction)
    parallax = signed_parallax(rays_a, rays_b, motion.phi, motion.direction)
    limit = SURE_SIGMAS * np.hypot(deviations, SURE_PX) / canvas.scale
    return np.asarray((np.abs(residual) < limit) & (parallax > _BEHIND))


def _distances(a: Described, b: Described) -> Array:
    """Return the distances (N, M) of descriptors."""
    square = (a.descriptors**2).sum(axis=1)[:, None] + (b.descriptors**2).sum(axis=1)
    square = square - 2.0 * (a.descriptors @ b.descriptors.T)
    return np.asarray(np.sqrt(np.maximum(square, 0.0)), dtype=np.float64)


def _pairs(
    a: Described, b: Described, motion: PlanarMotion, canvas: Canvas
) -> tuple[Indices, Array]:
    """Return pairs (P, 2) that look alike and that the motion does not explain, by target feature.

    And the distances (P,) of their descriptors.
    """
    distance = _distances(a, b)
    near = min(_NEAREST, *distance.shape) - 1
    alike_a = np.maximum(_RATIO * distance.min(axis=1), _ALIKE_DISTANCE)[:, None]
    alike_b = np.maximum(_RATIO * distance.min(axis=0), _ALIKE_DISTANCE)[None]
    kth_a = np.partition(distance, near, axis=1)[:, near, None]
    kth_b = np.partition(distance, near, axis=0)[None, near]
    wanted = (distance <= np.minimum(alike_a, kth_a)) | (distance <= np.minimum(alike_b, kth_b))
    pairs = np.argwhere(wanted)
    residual, _ = sampson_residuals(
        a.rays[pairs[:, 0]], b.rays[pairs[:, 1]], motion.phi, motion.direction
    )
    pairs = pairs[np.abs(residual) * canvas.scale >= _EXPLAINED_PX]
    far = distance[pairs[:, 0], pairs[:, 1]]
    kept = np.sort(np.argsort(far, kind="stable")[:_PAIRS])
    return pairs[kept], far[kept]


def _candidates(
    a: Described,
    b: Described,
    pairs: Indices,
    distance: Array,
    motion: PlanarMotion,
    canvas: Canvas,
    seed: int,
) -> list[tuple[tuple[float, float], Mask]]:
    """Return motions (θ, α) that many target features agree with, and the pairs that do."""
    rays_a, rays_b = a.rays[pairs[:, 0]], b.rays[pairs[:, 1]]
    rng = np.random.default_rng(seed)
    # One of each sample is from the better half: true pairs are rare among all.
    better = np.argsort(distance, kind="stable")[: max(_FEWEST_PAIRS, len(pairs) // 2)]
    first = better[rng.integers(0, len(better), _HYPOTHESES)]
    second = (first + rng.integers(1, len(pairs), _HYPOTHESES)) % len(pairs)
    # Two pairs with a feature in common determine nothing.
    samples = np.stack([first, second], axis=-1)[(pairs[first] != pairs[second]).all(axis=1)]
    if len(samples) == 0:
        return []
    begins = np.flatnonzero(np.r_[True, np.diff(pairs[:, 0]) != 0])

    def solve(samples: NDArray[np.int64]) -> Array:
        angles = two_point_motions(rays_a[samples], rays_b[samples])
        return angles[_other(angles, motion)]

    def score(limit2: float) -> Score:
        return partial(_unexplained, begins=begins, limit2=limit2)

    limit2 = (_GATE_PX / canvas.scale) ** 2
    found = ransac(
        samples,
        solve,
        lambda angles: squared_residuals(rays_a, rays_b, angles),
        limit2,
        score=score,
        keep=20 * _CANDIDATES,
    )
    chosen: list[tuple[float, float]] = []
    for theta, alpha in found.models.tolist():
        here = np.array([[theta, alpha]])
        if all(_apart(here, t, al - t, 0.0)[0] for t, al in chosen):
            chosen.append((theta, alpha))
        if len(chosen) == _CANDIDATES:
            break
    if not chosen:
        return []
    squared = squared_residuals(rays_a, rays_b, np.array(chosen))
    return list(zip(chosen, squared < limit2, strict=True))


def _unexplained(squared: Array, begins: Indices, limit2: float) -> Array:
    """Return minus the number of target features that agree with each motion (H,).

    A feature counts once, however many pairs of it agree; ``begins`` are the first ones.
    """
    inside = (squared < limit2).view(np.uint8)
    explained = np.maximum.reduceat(inside, begins, axis=1).sum(axis=1, dtype=np.float64)
    return np.asarray(-explained)


def _other(angles: Array, motion: PlanarMotion) -> Mask:
    """Return which motions (θ, α), (H, 2), are others than one that was found."""
    uncertain = _SIGMAS * motion.direction_sd
    return _apart(angles, motion.direction, motion.phi, min(uncertain, math.pi))


def _apart(angles: Array, direction: float, phi: float, uncertain: float) -> Mask:
    theta, alpha = angles.T
    turn = np.abs(wrap_angle(alpha - theta - phi))
    # A baseline has no sense of its own here.
    bearing = np.abs(wrap_angle(2.0 * (theta - direction))) / 2.0
    return np.asarray((turn > _HEADING) | (bearing > max(_BEARING, uncertain)))


def _one_each(pairs: Indices, distance: Array, inliers: Mask) -> Indices:
    """Return the pairs that agree, the most similar one of each target feature."""
    which = np.flatnonzero(inliers)
    which = which[np.argsort(distance[which], kind="stable")]
    return which[np.unique(pairs[which, 0], return_index=True)[1]]


def _aligned(at_target: Source, at_start: Source, a: Described, b: Described) -> tuple[Mask, Array]:
    """Return which patches are found in the other view, and where (N, 2)."""
    warps = np.eye(2) * (b.sizes / a.sizes)[:, None, None]
    patches = Patches((at_target, a.points))
    found = patches.align(at_start, np.arange(len(a)), b.points, warps, _STEPS)
    near = np.linalg.norm(found.points - b.points, axis=-1) < _MOST_CORRECTION_PX
    return (found.score > _ALIKE) & near, found.points


def _refined(
    rays_a: Array,
    rays_b: Array,
    angles: tuple[float, float],
    aligned: Mask,
    motion: PlanarMotion,
    canvas: Canvas,
) -> PlanarMotion | None:
    """Return a candidate refined on the patches that align, None if it is none any more."""
    theta, alpha = angles
    residual, _ = sampson_residuals(rays_a, rays_b, alpha - theta, theta)
    good = aligned & (np.abs(residual) * canvas.scale < _GATE_PX)
    if np.count_nonzero(good) < _FEWEST_ALIGNED:
        return None
    rival = refine_planar_motion(
        rays_a[good], rays_b[good], alpha - theta, theta, _SIGMA_PX / canvas.scale
    )
    angles_now = np.array([[rival.direction, rival.direction + rival.phi]])
    return rival if _other(angles_now, motion)[0] else None
