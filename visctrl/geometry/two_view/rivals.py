"""A second planar motion that explains two views as well, if there is one.

With all features in one plane there is: the two views then only determine a homography, and two
planar motions, degrees apart, have the same one. Both put the features in front of the robot more
often than not, so that nothing but the scene itself, or more views, can tell which is true.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from visctrl.geometry.robust.sampling import Samples, distinct_samples, ransac
from visctrl.geometry.two_view.parallax import signed_parallax
from visctrl.geometry.two_view.planar import (
    PlanarMotion,
    refine_motions,
    sampson_residuals,
    squared_residuals,
)
from visctrl.geometry.two_view.planar_2pt import two_point_motions
from visctrl.geometry.two_view.planar_fit import RayPairs
from visctrl.robots.unicycle import wrap_angle

Array = NDArray[np.float64]

#: Motions nearer to each other than this are one (rad), as are those within their deviations.
_APART, _APART_SIGMAS = 0.03, 4.0
_THRESHOLD_SIGMAS = 4.0
#: A rival explains at least this share of the features that the motion explains.
_SHARE = 0.9
#: Its squared residuals are at most this many times those of the motion, or of the noise.
_WORSE = 2.0
_FINALISTS = 3


def rival_motion(
    rays_a: ArrayLike,
    rays_b: ArrayLike,
    motion: PlanarMotion,
    sigma: float,
    *,
    seed: int = 0,
    hypotheses: int = 200,
) -> PlanarMotion | None:
    """Return another motion that fits the features as well, None if there is none.

    Parameters
    ----------
    rays_a, rays_b : (N, 3) arrays
        Unit rays of the same features in both views.
    motion : PlanarMotion
        What was found.
    sigma : float
        Standard deviation of one ray's direction (rad).
    seed : int
        Of the random samples.
    hypotheses : int
        Number of two-point samples.
    """
    a, b = (np.asarray(r, dtype=np.float64)[motion.inliers] for r in (rays_a, rays_b))
    if len(a) < 4:
        return None

    def other_motions(samples: Samples) -> Array:
        angles = two_point_motions(a[samples], b[samples])
        return angles[_apart(angles[:, 1] - angles[:, 0], motion)]

    found = ransac(
        distinct_samples(len(a), 2, hypotheses, seed),
        other_motions,
        lambda angles: squared_residuals(a, b, angles),
        (_THRESHOLD_SIGMAS * sigma) ** 2,
        keep=_FINALISTS,
    )
    starts = [(alpha - theta, theta) for theta, alpha in found.models.tolist()]
    if not starts:
        return None
    for rival in refine_motions(RayPairs.of(a, b, len(starts)), starts, sigma):
        other = _apart(np.array(rival.phi), motion).all()
        if other and _as_good(a, b, rival, motion, sigma):
            return rival
    return None


def _apart(phi: Array, motion: PlanarMotion) -> NDArray[np.bool_]:
    """Return whether headings are others than that of ``motion``."""
    turn = np.abs(wrap_angle(phi - motion.phi))
    return np.asarray(turn > max(_APART, _APART_SIGMAS * motion.phi_sd))


def _as_good(a: Array, b: Array, rival: PlanarMotion, motion: PlanarMotion, sigma: float) -> bool:
    found, _ = sampson_residuals(a, b, motion.phi, motion.direction)
    other, _ = sampson_residuals(a, b, rival.phi, rival.direction)
    limit = _THRESHOLD_SIGMAS * sigma
    parallax = signed_parallax(a, b, rival.phi, rival.direction)
    inside = (np.abs(other) < limit) & (parallax > -2.0 * limit)
    enough = np.count_nonzero(inside) >= _SHARE * len(a)
    noise = max(float(np.median(found**2)), (0.5 * sigma) ** 2)
    return bool(enough and float(np.median(other**2)) < _WORSE * noise)
