"""Solving for the epipoles of one pair of views, tick after tick."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from hal.central_camera import CentralCamera
from robots.errors import InputError
from robots.unicycle import wrap_angle
from visctrl.geometry.epipolar import Epipole
from visctrl.geometry.epipolar_planar import (
    MINIMUM_FEATURES,
    ONE_PLANE,
    PlanarEpipoles,
    ransac_planar_epipoles,
    refine_planar_epipoles,
    turned,
)
from visctrl.geometry.epipolar_robust import robust_essential, robust_fundamental
from visctrl.geometry.horizon import find_horizon
from visctrl.geometry.parallax import signed_parallax
from visctrl.geometry.planar import (
    PlanarMotion,
    ransac_planar_motion,
    refine_planar_motion,
    sampson_residuals,
)
from visctrl.geometry.planar_rivals import rival_motion
from visctrl.plugins import Health

Array = NDArray[np.float64]
Solver = Literal["auto", "planar-free", "planar", "eight-point"]

#: A followed motion is kept while this share of the features agrees with it.
_MIN_SHARE = 0.6
#: Features further than this from the predicted motion are outliers (standard deviations).
_GATE_SIGMAS = 8.0
#: While the motion is not determined, every so many calls search it anew.
_SEARCH_EVERY = 4
#: Parallax (rad) from which a feature has a full vote on the sense of the motion.
_FAR_PARALLAX = 0.005
#: Rays less far forward than this have no place in a perspective image.
_MIN_FORWARD = 1e-3


class PairSolver(Protocol):
    """A way to find a pair's motion, from scratch or near one that is known."""

    def search(self, a: Array, b: Array, sigma: float, hypotheses: int, seed: int) -> PlanarMotion:
        """Return the motion that most of the rays (N, 3) agree with."""

    def refine(
        self, a: Array, b: Array, near: PlanarMotion, turns: tuple[float, float], sigma: float
    ) -> PlanarMotion:
        """Return the motion near one of before the views turned by ``turns`` (rad)."""


class Calibrated:
    """Planar motion of a calibrated central camera, on unit rays."""

    def search(self, a: Array, b: Array, sigma: float, hypotheses: int, seed: int) -> PlanarMotion:
        """Return the motion that most of the rays (N, 3) agree with."""
        motion = ransac_planar_motion(a, b, sigma, seed=seed, hypotheses=hypotheses)
        if motion.health is Health.OK and rival_motion(a, b, motion, sigma, seed=seed) is not None:
            unknown = np.diag([np.inf, np.inf])
            return replace(motion, covariance=unknown, health=Health.DEGENERATE, reason=ONE_PLANE)
        return motion

    def refine(
        self, a: Array, b: Array, near: PlanarMotion, turns: tuple[float, float], sigma: float
    ) -> PlanarMotion:
        """Return the motion near one of before the views turned by ``turns`` (rad)."""
        phi, direction = near.phi + turns[1] - turns[0], near.direction + turns[0]
        residual, _ = sampson_residuals(a, b, phi, direction)
        inside = np.abs(residual) < _GATE_SIGMAS * sigma
        motion = refine_planar_motion(a[inside], b[inside], phi, direction, sigma)
        inliers = inside.copy()
        inliers[inside] = motion.inliers
        return replace(motion, inliers=inliers)


class Uncalibrated:
    """Planar motion of a perspective camera whose focal length is a guess.

    horizon : height (for a unit focal length) of the horizon over its assumed row.
    """

    def __init__(self) -> None:
        self.horizon = 0.0

    def level(self, a: Array, b: Array, sigma: float, widest: float, seed: int) -> None:
        """Find the horizon from rays (N, 3) of two views, at most ``widest`` off.

        An uncertain one stays near the assumed row, half of ``widest`` being its deviation.
        """
        self.horizon = 0.0
        if len(a) >= MINIMUM_FEATURES and widest > 0.0:
            found = find_horizon(*self._points(a, b), sigma, widest, seed=seed)
            prior = (widest / 2.0) ** 2
            self.horizon = found.shift * prior / (prior + found.sd**2)

    def search(self, a: Array, b: Array, sigma: float, hypotheses: int, seed: int) -> PlanarMotion:
        """Return the motion that most of the rays (N, 3) agree with."""
        points = self._points(a, b)
        return ransac_planar_epipoles(*points, sigma, seed=seed, hypotheses=hypotheses)

    def refine(
        self, a: Array, b: Array, near: PlanarMotion, turns: tuple[float, float], sigma: float
    ) -> PlanarMotion:
        """Return the motion near one of before the views turned by ``turns`` (rad)."""
        assert isinstance(near, PlanarEpipoles)
        return refine_planar_epipoles(*self._points(a, b), turned(near.vector, *turns), sigma)

    def _points(self, a: Array, b: Array) -> tuple[Array, Array]:
        up = np.array([0.0, self.horizon])
        return _points(a) - up, _points(b) - up


class EightPoint:
    """General motion by the 8-point solution, for comparison: nothing is assumed to be planar.

    Rays give an essential matrix; a perspective camera's points a fundamental matrix, whose
    epipoles are then in the units of the assumed calibration.
    """

    def __init__(self, *, uncalibrated: bool) -> None:
        self._uncalibrated = uncalibrated

    def search(self, a: Array, b: Array, sigma: float, hypotheses: int, seed: int) -> PlanarMotion:
        """Return the planar part of the general motion that most of the rays agree with."""
        if self._uncalibrated:
            points = _points(a), _points(b)
            found = robust_fundamental(*points, sigma, seed=seed, max_hypotheses=hypotheses)
            e_a, e_b = (_upright(e) for e in (found.epipole_a, found.epipole_b))
        else:
            found = robust_essential(a, b, sigma, seed=seed, max_hypotheses=hypotheses)
            e_a, e_b = found.epipole_a, found.epipole_b
        if found.health is Health.LOST:
            unknown = np.diag([np.inf, np.inf])
            return PlanarMotion(0.0, 0.0, unknown, found.inliers, found.health, found.degeneracy)
        theta, turn = _senses(a[found.inliers], b[found.inliers], e_a.bearing, e_b.bearing)
        var_a, var_b = e_a.bearing_sd**2, e_b.bearing_sd**2
        covariance = np.array([[var_a + var_b, -var_a], [-var_a, var_a]])
        return PlanarMotion(
            turn, theta, covariance, found.inliers, found.health, str(found.degeneracy)
        )

    def refine(
        self, a: Array, b: Array, near: PlanarMotion, turns: tuple[float, float], sigma: float
    ) -> PlanarMotion:
        """Return a new search: the general solution gains nothing from the last one."""
        del near, turns
        return self.search(a, b, sigma, hypotheses=256, seed=len(a))


def _upright(epipole: Epipole) -> Epipole:
    """Return an epipole (x, y, 1)-wise as one along (right, forward, up)."""
    order = [0, 2, 1]
    return Epipole(epipole.direction[order], epipole.covariance[np.ix_(order, order)])


def _senses(a: Array, b: Array, theta: float, alpha: float) -> tuple[float, float]:
    """Return the bearing of b's centre and b's heading from the baseline's two line angles."""
    turns = [float(wrap_angle(alpha - theta + half)) for half in (0.0, np.pi)]
    misfits = [float(np.median(np.abs(sampson_residuals(a, b, t, theta)[0]))) for t in turns]
    turn = turns[int(np.argmin(misfits))]
    votes = np.tanh(signed_parallax(a, b, turn, theta) / _FAR_PARALLAX)
    return float(wrap_angle(theta if votes.sum() >= 0.0 else theta + np.pi)), turn


def solver_for(name: Solver, camera: CentralCamera) -> PairSolver:
    """Return a solver by name.

    Raises
    ------
    InputError
        ``planar-free`` for a camera that is not perspective.
    """
    perspective = camera.xi == 0.0 and not camera.panoramic
    if name == "eight-point":
        return EightPoint(uncalibrated=perspective)
    if name == "auto":
        return Uncalibrated() if perspective else Calibrated()
    if name == "planar":
        return Calibrated()
    if not perspective:
        raise InputError(
            f"solver '{name}' needs a perspective camera looking ahead, and '{camera.name}' is "
            "not one: choose 'planar' or 'auto'"
        )
    return Uncalibrated()


class PairFollower:
    """Epipoles of one pair of views: searched once, then followed while that is sound."""

    def __init__(self, solver: PairSolver, hypotheses: int) -> None:
        self._solver = solver
        self._hypotheses = hypotheses
        self._last: PlanarMotion | None = None
        self._calls = 0

    def _may_follow(self, last: PlanarMotion) -> bool:
        """Return whether the last motion is a start; one that is not determined may mislead."""
        if last.reason == ONE_PLANE:
            return False
        if last.health is Health.DEGENERATE:
            return self._calls % _SEARCH_EVERY != 0
        return last.health is Health.OK

    def update(
        self, a: Array, b: Array, sigma: float, turns: tuple[float, float], seed: int
    ) -> PlanarMotion:
        """Return the motion between the views with rays ``a`` and ``b`` (N, 3).

        Parameters
        ----------
        a, b : (N, 3) arrays
            Unit rays of the same features in both views.
        sigma : float
            Standard deviation of one ray's direction (rad).
        turns : pair of float
            How far the views turned since the last call (rad, counter-clockwise).
        seed : int
            Of a search from scratch.
        """
        motion: PlanarMotion | None = None
        self._calls += 1
        if self._last is not None and self._may_follow(self._last):
            motion = self._solver.refine(a, b, self._last, turns, sigma)
            agreeing = int(motion.inliers.sum())
            if motion.health is Health.LOST or agreeing < _MIN_SHARE * len(a):
                motion = None
        if motion is None:
            motion = self._solver.search(a, b, sigma, self._hypotheses, seed)
        self._last = motion
        return motion


def _points(rays: Array) -> Array:
    """Return (right, up)/forward of rays (N, 3)."""
    return np.asarray(rays[:, [0, 2]] / np.maximum(rays[:, 1:2], _MIN_FORWARD))
