"""General motion by MAGSAC on every pair of views, for comparison: nothing is taken for planar."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.two_view.degeneracy import Degeneracy
from visctrl.geometry.two_view.general_motion import magsac
from visctrl.geometry.two_view.parallax import signed_parallax
from visctrl.geometry.two_view.planar import PlanarMotion, sampson_residuals
from visctrl.robots.unicycle import wrap_angle
from visctrl.schemes.epipolar.motion_solvers import Calibrated, image_points

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Parallax (rad) from which a feature has a full vote on the sense of the motion: ten times the
#: noise of half a pixel at a focal length of 600.
_FAR_PARALLAX = 0.008
#: Samples at most of a pair that was followed before.
_ITERATIONS = 1000


class GeneralMotion:
    """Epipoles of a perspective camera from the fundamental or the essential matrix.

    The fundamental matrix knows nothing of the calibration: its epipoles are in the units of the
    assumed one.
    """

    def __init__(self, *, calibrated: bool) -> None:
        self._calibrated = calibrated

    def search(self, a: Array, b: Array, sigma: float, hypotheses: int, seed: int) -> PlanarMotion:
        """Return the planar part of the general motion that most of the rays agree with."""
        found = magsac(
            image_points(a.T).T,
            image_points(b.T).T,
            sigma,
            calibrated=self._calibrated,
            seed=seed,
            max_iterations=hypotheses,
        )
        e_a, e_b = found.epipole_a, found.epipole_b
        if not found.inliers.any():
            unknown = np.diag([np.inf, np.inf])
            return PlanarMotion(0.0, 0.0, unknown, found.inliers, Degeneracy.NO_AGREEMENT)
        theta, turn = _senses(a[found.inliers], b[found.inliers], e_a.bearing, e_b.bearing)
        var_a, var_b = e_a.bearing_sd**2, e_b.bearing_sd**2
        covariance = np.array([[var_a + var_b, -var_a], [-var_a, var_a]])
        return PlanarMotion(turn, theta, covariance, found.inliers, found.degeneracy)

    def follow(
        self,
        rays: tuple[Array, Array],
        present: Mask | None,
        last: list[PlanarMotion],
        turn: float,
        sigma: float,
    ) -> list[PlanarMotion]:
        """Return new searches: the general solution gains nothing from the last ones."""
        del last, turn
        fixed, current = rays
        found = []
        for index, view in enumerate(fixed):
            a, b = view.T, current.T
            if present is not None:
                a, b = a[present[index]], b[present[index]]
            found.append(self.search(a, b, sigma, hypotheses=_ITERATIONS, seed=len(a)))
        return found

    def unmoved(self) -> PlanarMotion:
        """Return no motion at all; it is not followed."""
        return Calibrated().unmoved()

    def redirected(
        self, a: Array, b: Array, last: PlanarMotion, turn: float, sigma: float
    ) -> PlanarMotion:
        """Return ``last``: it is not followed."""
        del a, b, turn, sigma
        return last


def _senses(a: Array, b: Array, theta: float, alpha: float) -> tuple[float, float]:
    """Return the bearing of b's centre and b's heading from the baseline's two line angles."""
    turns = [float(wrap_angle(alpha - theta + half)) for half in (0.0, math.pi)]
    misfits = [float(np.median(np.abs(sampson_residuals(a, b, t, theta)[0]))) for t in turns]
    turn = turns[int(np.argmin(misfits))]
    votes = np.tanh(signed_parallax(a, b, turn, theta) / _FAR_PARALLAX)
    return float(wrap_angle(theta if votes.sum() >= 0.0 else theta + math.pi)), turn
