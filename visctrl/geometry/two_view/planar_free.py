"""Epipoles of two views of a perspective camera that moves in a plane, without calibration.

Image points are (x, y) = (right, up)/forward for an *assumed* focal length and image centre.
With the baseline along the bearings θ_a and θ_b of the two views, planar motion gives

    y_b (x_a c_a − s_a) − y_a (x_b c_b − s_b) = 0,   tan θ = s/c,

linear in m = (c_a, s_a, c_b, s_b). A wrong focal length or centre column is a linear change of
x that m absorbs: it only makes the norms of (c_a, s_a) and (c_b, s_b) differ. So with these
norms left free the epipoles come out in the very units of the points, whatever the true focal
length, and one at infinity (c = 0) is as good as any other. Only the horizon's row must be known.
`planar` is the calibrated counterpart, with equal norms, for any central camera.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from visctrl.geometry.robust.sampling import distinct_samples, ransac, truncated_squares
from visctrl.geometry.two_view import planar_free_fit
from visctrl.geometry.two_view.degeneracy import Degeneracy
from visctrl.geometry.two_view.planar import PlanarMotion
from visctrl.geometry.two_view.planar_free_3pt import constraint_rows, null_vectors
from visctrl.geometry.two_view.planar_free_residuals import Lines, PointPairs, squared_residuals

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Vector = tuple[float, float, float, float]

#: Three features fix m; fewer than this leave no residual to judge it by.
MINIMUM_FEATURES = 5
#: Hypotheses that are refined before the best is chosen, and by how many steps.
_FINALISTS, _FINALIST_STEPS = 4, 2
#: Steps on the best of them, at most.
_STEPS = 12


@dataclass(frozen=True)
class PlanarEpipoles(PlanarMotion):
    """A planar motion whose bearings are in the units of an assumed calibration.

    ``phi`` is the difference of the baseline's two bearings, B's heading if that calibration
    is right.

    vector : m = (c_a, s_a, c_b, s_b) of unit length, pointing from A's centre to B's.
    """

    vector: Vector = (0.0, 0.0, 0.0, 0.0)


def sampson_residuals(
    points_a: ArrayLike, points_b: ArrayLike, m: ArrayLike
) -> tuple[Array, Array]:
    """Return the Sampson residuals (N,) of points (N, 2) for m (4,), and ∂/∂m (4, N).

    To first order a residual has the standard deviation of one image coordinate.
    """
    c, s, c_b, s_b = vector = _vector(m)
    linear = PointPairs.of(points_a, points_b).linearised([_lines(vector)])
    by_phi, by_theta, by_scale = linear.jacobian
    by_theta = by_theta - by_phi
    # The same for any length of m: only θ, α and the ratio of both parts' lengths matter.
    a2, b2 = c * c + s * s, c_b * c_b + s_b * s_b
    slopes = np.array(
        [
            (-s * by_theta - c * by_scale) / a2,
            (c * by_theta - s * by_scale) / a2,
            (-s_b * by_phi + c_b * by_scale) / b2,
            (c_b * by_phi + s_b * by_scale) / b2,
        ]
    )
    return linear.residual, slopes


def ransac_planar_epipoles(
    points_a: ArrayLike,
    points_b: ArrayLike,
    sigma: float,
    *,
    seed: int = 0,
    threshold_sigmas: float = 4.0,
    hypotheses: int = 96,
) -> PlanarEpipoles:
    """Find the planar epipolar geometry that most features agree with, and refine it on them.

    Parameters
    ----------
    points_a, points_b : (N, 2) arrays
        (right, up)/forward of the same features in both views, by the assumed calibration.
    sigma : float
        Standard deviation of one coordinate.
    seed : int
        Of the random samples; the same seed gives the same result.
    threshold_sigmas : float
        Residual (in ``sigma``) beyond which a feature counts as an outlier.
    hypotheses : int
        Number of three-point samples, all scored in one array operation.
    """
    a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    if len(a) < MINIMUM_FEATURES:
        return _too_few(len(a))
    limit = threshold_sigmas * sigma
    starts = likely_lines(a, b, limit, hypotheses, seed, _FINALISTS)
    ends, _ = planar_free_fit.descend(
        PointPairs.of(a, b, len(starts)), starts, sigma, limit=limit, iterations=_FINALIST_STEPS
    )
    squared = squared_residuals(a, b, np.array([_unit_vector(lines) for lines in ends]))
    best = _unit_vector(ends[int(np.argmin(truncated_squares(limit**2)(squared)))])
    return refine_epipoles(PointPairs.of(a, b), [best], sigma, limit=limit)[0]


def likely_lines(
    a: Array, b: Array, limit: float, hypotheses: int, seed: int, count: int
) -> list[Lines]:
    """Return those of random samples' lines that most points (N, 2) lie nearer to than a limit."""
    rows = constraint_rows(a, b)
    found = ransac(
        distinct_samples(len(a), 3, hypotheses, seed),
        lambda samples: null_vectors(rows[samples]),
        lambda m: squared_residuals(a, b, m),
        limit**2,
        keep=count,
    )
    return [_lines(_vector(m)) for m in found.models]


def refine_epipoles(
    pairs: PointPairs,
    starts: Sequence[Vector],
    sigma: float,
    *,
    limit: float,
    present: Mask | None = None,
) -> list[PlanarEpipoles]:
    """Refine the planar epipoles of several pairs of views in one go.

    Parameters
    ----------
    pairs : PointPairs
    starts : m to start from, one a pair
        Their senses are found anew.
    sigma : float
        Standard deviation of one coordinate.
    limit : float
        Features with larger residuals are outliers.
    present : (P, N) array or None
        Features that a pair has at all; None for all.
    """
    if pairs.features < MINIMUM_FEATURES:
        return [_too_few(pairs.features) for _ in starts]
    usable = None if present is None else present.ravel()
    lines = [_lines(start) for start in starts]
    fits = planar_free_fit.fit(pairs, lines, sigma, limit=limit, usable=usable, iterations=_STEPS)
    return [_epipoles(found) for found in fits]


def turned(m: Vector, turn_a: float = 0.0, turn_b: float = 0.0) -> Vector:
    """Return m after the views turned by ``turn_a``, ``turn_b`` (rad, counter-clockwise)."""
    c, s, c_b, s_b = math.cos(turn_a), math.sin(turn_a), math.cos(turn_b), math.sin(turn_b)
    # A turn to the left moves every bearing to the right.
    return (
        c * m[0] - s * m[1],
        s * m[0] + c * m[1],
        c_b * m[2] - s_b * m[3],
        s_b * m[2] + c_b * m[3],
    )


def _epipoles(found: planar_free_fit.LinesFit) -> PlanarEpipoles:
    count, features = int(np.count_nonzero(found.inliers)), len(found.inliers)
    if count < MINIMUM_FEATURES:
        shown = f"{count} of {features} features fit one motion, {MINIMUM_FEATURES} are needed"
        return _lost(features, Degeneracy.NO_AGREEMENT, shown)
    pp, pt, tt = found.variance
    return PlanarEpipoles(
        found.lines[0],
        found.lines[1],
        np.array([[pp, pt], [pt, tt]]),
        found.inliers,
        found.degeneracy,
        vector=_unit_vector(found.lines),
    )


def _lines(m: Vector) -> Lines:
    """Return (φ, θ, λ) of m."""
    c, s, c_b, s_b = m
    theta, alpha = math.atan2(s, c), math.atan2(s_b, c_b)
    ratio = max(math.hypot(c_b, s_b), 1e-9) / max(math.hypot(c, s), 1e-9)
    return alpha - theta, theta, math.log(ratio)


def _unit_vector(lines: Lines) -> Vector:
    """Return m of (φ, θ, λ)."""
    phi, theta, scale = lines
    ratio = math.exp(scale)
    a = 1.0 / math.hypot(1.0, ratio)
    b = a * ratio
    alpha = theta + phi
    return a * math.cos(theta), a * math.sin(theta), b * math.cos(alpha), b * math.sin(alpha)


def _vector(elements: ArrayLike) -> Vector:
    c, s, c_b, s_b = np.asarray(elements, dtype=np.float64).tolist()
    return c, s, c_b, s_b


def _too_few(count: int) -> PlanarEpipoles:
    return _lost(count, Degeneracy.TOO_FEW, f"{count}, {MINIMUM_FEATURES} are needed")


def _lost(count: int, degeneracy: Degeneracy, detail: str) -> PlanarEpipoles:
    unknown = np.diag([np.inf, np.inf])
    none = np.zeros(count, dtype=np.bool_)
    return PlanarEpipoles(0.0, 0.0, unknown, none, degeneracy, detail)
