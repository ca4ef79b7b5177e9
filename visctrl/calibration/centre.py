"""The projection centre of an omnidirectional camera, from the images of vertical lines.

Where the camera's axis is vertical, vertical lines project to radial ones, and the centre is
where they meet. RANSAC over pairs of line segments finds it among everything else that has
straight edges; all hypotheses are judged in one array operation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.calibration.edges import Segments
from visctrl.geometry.robust.least_squares import Options, Solved, gauss_newton
from visctrl.geometry.robust.sampling import Samples, ransac
from visctrl.robots.errors import InputError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_GATE_SIGMAS = 3.0
_HYPOTHESES = 4000
_REFINEMENTS = 15
#: Condition number beyond which lines are parallel but for their noise.
_MOST_CONDITION = 1e6
#: More segments than chance lets point at the centre: by so many deviations, and at least so many.
_SIGNIFICANT, _LEAST_SEGMENTS = 4.0, 4
#: Beyond this standard deviation the lines do not determine the centre (px).
_MOST_SIGMA_PX = 2.0


@dataclass(frozen=True)
class Centre:
    """A projection centre.

    point : (2,) (px); covariance : (2, 2) (px²).
    radial : (N,) which segments point at it.
    """

    point: Array
    covariance: Array
    radial: Mask

    @property
    def sigmas(self) -> Array:
        """Standard deviations of the coordinates (2,) (px)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def find_centre(segments: Segments, size: tuple[int, int], seed: int) -> Centre:
    """Return the point in the picture at which most segments point.

    Parameters
    ----------
    segments : Segments
        Of one image, or of several by one camera.
    size : (width, height)
        Of the images (px).
    seed : int
        Of the random pairs.

    Raises
    ------
    InputError
        No point is met by more lines than chance explains, or they leave it undetermined.
    """
    start = _consensus(segments, size, seed)
    if start is None:
        raise InputError(_nothing(0, len(segments)))
    point, _, _, _ = gauss_newton(
        lambda point: _agreement(segments, point[None]),
        lambda at: _solve(segments, *(values[0] for values in at)),
        lambda point, step: np.asarray(point + step),
        start,
        Options(_REFINEMENTS),
    )
    miss, sigma, agree = (values[0] for values in _agreement(segments, point[None]))
    radial = agree > 0.0
    expected = _by_chance(segments, point, sigma)
    needed = expected + _SIGNIFICANT * np.sqrt(expected) + _LEAST_SEGMENTS
    if radial.sum() < needed:
        raise InputError(_nothing(int(radial.sum()), len(segments)))
    covariance = _covariance(segments.subset(radial), miss[radial], sigma[radial])
    if np.sqrt(np.linalg.eigvalsh(covariance)[-1]) > _MOST_SIGMA_PX:
        raise InputError(
            f"the {radial.sum()} vertical lines lie in too few directions: take images that show "
            "vertical edges all round"
        )
    return Centre(point, covariance, radial)


def _agreement(segments: Segments, points: Array) -> tuple[Array, Array, Array]:
    """Return misses, their standard deviations, and agreement in [0, 1] with points (M, 2).

    All (M, N). A line that ends near a point does not count: the image of a vertical line
    never comes near the centre, but the chords of a mirror's rim meet each other on the rim.
    """
    miss, sigma = segments.misses(points)
    distance = np.linalg.norm(points[:, None] - segments.middle, axis=-1)
    apart = distance > segments.length
    agree = np.clip(1.0 - (miss / (_GATE_SIGMAS * sigma)) ** 2, 0.0, None) * apart
    return miss, sigma, agree


def _consensus(segments: Segments, size: tuple[int, int], seed: int) -> Array | None:
    """Return the best intersection of two segments within the picture."""
    n = len(segments)
    if n < 2:
        return None
    # Long segments know their direction best, and are drawn more often.
    share = segments.length / segments.length.sum()
    pairs = np.random.default_rng(seed).choice(n, (2, _HYPOTHESES), p=share).T

    def intersections(pairs: Samples) -> Array:
        a, b = pairs.T
        p, q = segments.along[a], segments.along[b]
        sine = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
        apart = segments.middle[b] - segments.middle[a]
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (apart[:, 0] * q[:, 1] - apart[:, 1] * q[:, 0]) / sine
            points = segments.middle[a] + along[:, None] * p
            inside = ((points > 0) & (points < np.array(size))).all(axis=1) & (np.abs(sine) > 0.1)
        return np.asarray(points[inside])

    def disagreement(points: Array) -> Array:
        _, sigma, agree = _agreement(segments, points)
        # By their precision, too: what a short segment points at says little.
        return np.asarray(1.0 - agree * (sigma.min(initial=np.inf) / sigma))

    found = ransac(pairs, intersections, disagreement, 1.0)
    return found.models[0] if len(found.models) else None


def _solve(segments: Segments, miss: Array, sigma: Array, agree: Array) -> Solved[Array]:
    """Return the least-squares step (2,) towards the lines' common point, with Tukey's biweight.

    It redescends: what does not point here belongs to something else.
    """
    weight = agree**2 / sigma**2
    J = np.stack([segments.along[:, 1], -segments.along[:, 0]], axis=-1)
    normal = J.T @ (weight[:, None] * J)
    if np.linalg.cond(normal) > _MOST_CONDITION:
        raise InputError(_nothing(int((weight > 0).sum()), len(segments)))
    step = np.asarray(-np.linalg.solve(normal, J.T @ (weight * miss)), dtype=np.float64)
    return Solved(step, math.inf)


def _covariance(segments: Segments, miss: Array, sigma: Array) -> Array:
    """Return the covariance of the common point, scaled by how well the lines agree."""
    J = np.stack([segments.along[:, 1], -segments.along[:, 0]], axis=-1) / sigma[:, None]
    scale = max(0.1, float(((miss / sigma) ** 2).sum()) / max(1, len(segments) - 2))
    return np.asarray(np.linalg.inv(J.T @ J) * scale)


def _by_chance(segments: Segments, point: Array, sigma: Array) -> float:
    """Return how many segments of random direction would point at a point."""
    distance = np.linalg.norm(point - segments.middle, axis=1)
    share = np.clip(_GATE_SIGMAS * sigma / np.maximum(distance, 1e-9), 0.0, 1.0)
    return float((2.0 / np.pi * np.arcsin(share)).sum())


def _nothing(radial: int, segments: int) -> str:
    return (
        f"no vertical lines: of {segments} straight edges only {radial} point at one place, no "
        "more than by chance; show the camera door frames, shelves or corners of the room, its "
        "axis upright"
    )
