"""Solving for the epipoles of one pair of views, tick after tick."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from hal.central_camera import CentralCamera
from robots.errors import InputError
from visctrl.geometry.epipolar_planar import (
    PlanarEpipoles,
    ransac_planar_epipoles,
    refine_planar_epipoles,
    turned,
)
from visctrl.geometry.planar import (
    PlanarMotion,
    ransac_planar_motion,
    refine_planar_motion,
    sampson_residuals,
)
from visctrl.plugins import Health

Array = NDArray[np.float64]
Solver = Literal["auto", "planar-free", "planar"]

#: A followed motion is kept while this share of the features agrees with it.
_MIN_SHARE = 0.6
#: Features further than this from the predicted motion are outliers (standard deviations).
_GATE_SIGMAS = 8.0
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
        return ransac_planar_motion(a, b, sigma, seed=seed, hypotheses=hypotheses)

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
    """Planar motion of a perspective camera whose focal length is a guess."""

    def search(self, a: Array, b: Array, sigma: float, hypotheses: int, seed: int) -> PlanarMotion:
        """Return the motion that most of the rays (N, 3) agree with."""
        a, b = _points(a, b)
        return ransac_planar_epipoles(a, b, sigma, seed=seed, hypotheses=hypotheses)

    def refine(
        self, a: Array, b: Array, near: PlanarMotion, turns: tuple[float, float], sigma: float
    ) -> PlanarMotion:
        """Return the motion near one of before the views turned by ``turns`` (rad)."""
        assert isinstance(near, PlanarEpipoles)
        return refine_planar_epipoles(*_points(a, b), turned(near.vector, *turns), sigma)


def solver_for(name: Solver, camera: CentralCamera) -> PairSolver:
    """Return a solver by name.

    Raises
    ------
    InputError
        ``planar-free`` for a camera that is not perspective.
    """
    perspective = camera.xi == 0.0 and not camera.panoramic
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
        if self._last is not None and self._last.health is Health.OK:
            motion = self._solver.refine(a, b, self._last, turns, sigma)
            agreeing = int(motion.inliers.sum())
            if motion.health is Health.LOST or agreeing < _MIN_SHARE * len(a):
                motion = None
        if motion is None:
            motion = self._solver.search(a, b, sigma, self._hypotheses, seed)
        self._last = motion
        return motion


def _points(a: Array, b: Array) -> tuple[Array, Array]:
    """Return (right, up)/forward of both views' rays."""
    forward_a, forward_b = (np.maximum(rays[:, 1:2], _MIN_FORWARD) for rays in (a, b))
    return a[:, [0, 2]] / forward_a, b[:, [0, 2]] / forward_b
