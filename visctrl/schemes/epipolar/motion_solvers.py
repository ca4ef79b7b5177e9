"""Ways to find the motion between two views, from scratch or near one that is known."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.robust.sampling import truncated_squares
from visctrl.geometry.two_view.degeneracy import Degeneracy
from visctrl.geometry.two_view.horizon import find_horizon
from visctrl.geometry.two_view.planar import (
    PlanarMotion,
    ransac_planar_motion,
    refine_motions,
    squared_residuals,
)
from visctrl.geometry.two_view.planar_fit import RayPairs
from visctrl.geometry.two_view.planar_free import (
    MINIMUM_FEATURES,
    PlanarEpipoles,
    ransac_planar_epipoles,
    refine_epipoles,
    turned,
)
from visctrl.geometry.two_view.planar_free_residuals import PointPairs
from visctrl.geometry.two_view.planar_free_residuals import (
    squared_residuals as squared_point_residuals,
)
from visctrl.geometry.two_view.rivals import rival_motion
from visctrl.hal.cameras.central import CentralCamera
from visctrl.robots.errors import InputError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Solver = Literal["auto", "planar-free", "planar", "fundamental", "essential"]

#: Features further than this from a followed motion are outliers (standard deviations): of a
#: calibrated camera's rays, and of points, of which one that lies near its epipolar line by
#: chance does more harm.
_RAY_SIGMAS, _POINT_SIGMAS = 8.0, 4.0
#: Directions among which that of a baseline is looked for whose turn is known.
_DIRECTIONS: Array = np.linspace(0.0, math.pi, 12, endpoint=False)
#: A residual counts at most this many standard deviations there.
_COUNTED_SIGMAS = 4.0
#: Rays less far forward than this have no place in a perspective image.
_MIN_FORWARD = 1e-3


class PairSolver(Protocol):
    """A way to find the motion of the current view in a fixed one."""

    def search(self, a: Array, b: Array, sigma: float, hypotheses: int, seed: int) -> PlanarMotion:
        """Return the motion of view b in view a that most of the rays (N, 3) agree with."""

    def follow(
        self,
        rays: tuple[Array, Array],
        present: Mask | None,
        last: list[PlanarMotion],
        turn: float,
        sigma: float,
    ) -> list[PlanarMotion]:
        """Return the motions near the last ones, before the current view turned.

        Parameters
        ----------
        rays : (P, 3, N) and (3, N) arrays
            Of the fixed views and of the current one.
        present : (P, N) array or None
            Features that a fixed view has at all; None for all.
        last : P motions
        turn : float
            How far the current view turned since (rad).
        sigma : float
            Standard deviation of one ray's direction (rad).
        """

    def unmoved(self) -> PlanarMotion:
        """Return the motion between two views from the same place."""

    def redirected(
        self, a: Array, b: Array, last: PlanarMotion, turn: float, sigma: float
    ) -> PlanarMotion:
        """Return ``last`` with the direction that suits the rays (N, 3) best, its turn given."""


class Calibrated:
    """Planar motion of a calibrated central camera, on unit rays."""

    def __init__(self) -> None:
        #: The pairs that are followed, and the fixed views that they were made of.
        self._pairs: RayPairs | None = None
        self._fixed: Array | None = None

    def search(self, a: Array, b: Array, sigma: float, hypotheses: int, seed: int) -> PlanarMotion:
        """Return the motion that most of the rays agree with (see the protocol)."""
        motion = ransac_planar_motion(a, b, sigma, seed=seed, hypotheses=hypotheses)
        if motion.determined and rival_motion(a, b, motion, sigma, seed=seed) is not None:
            unknown = np.diag([np.inf, np.inf])
            return replace(motion, covariance=unknown, degeneracy=Degeneracy.ONE_PLANE)
        return motion

    def follow(
        self,
        rays: tuple[Array, Array],
        present: Mask | None,
        last: list[PlanarMotion],
        turn: float,
        sigma: float,
    ) -> list[PlanarMotion]:
        """Return the motions near the last ones (see the protocol)."""
        starts = [(motion.phi + turn, motion.direction) for motion in last]
        pairs = self._seen(*rays)
        return refine_motions(pairs, starts, sigma, limit_sigmas=_RAY_SIGMAS, present=present)

    def _seen(self, fixed: Array, current: Array) -> RayPairs:
        """Return the pairs of fixed views and the current one; what is fixed is kept."""
        if self._pairs is None or self._fixed is not fixed:
            self._pairs, self._fixed = RayPairs(fixed, current), fixed
        else:
            self._pairs.look(current)
        return self._pairs

    def unmoved(self) -> PlanarMotion:
        """Return no motion at all (see the protocol)."""
        unknown, nobody = np.diag([0.0, np.inf]), np.zeros(0, dtype=np.bool_)
        return PlanarMotion(0.0, 0.0, unknown, nobody, Degeneracy.IDENTICAL)

    def redirected(
        self, a: Array, b: Array, last: PlanarMotion, turn: float, sigma: float
    ) -> PlanarMotion:
        """Return ``last`` in the best direction (see the protocol)."""
        angles = np.stack([_DIRECTIONS, _DIRECTIONS + (last.phi + turn)], axis=-1)
        best = _least(squared_residuals(a, b, angles), sigma)
        return replace(last, direction=float(_DIRECTIONS[best]))


class Uncalibrated:
    """Planar motion of a perspective camera whose focal length is a guess.

    horizon : height (for a unit focal length) of the horizon over its assumed row.
    """

    def __init__(self) -> None:
        self.horizon = 0.0
        #: The pairs that are followed, and the fixed views that they were made of.
        self._pairs: PointPairs | None = None
        self._fixed: Array | None = None

    def level(self, a: Array, b: Array, sigma: float, widest: float, seed: int) -> None:
        """Find the horizon from rays (N, 3) of two views, at most ``widest`` off.

        An uncertain one stays near the assumed row, half of ``widest`` being its deviation.
        """
        self.horizon, self._fixed = 0.0, None
        if len(a) >= MINIMUM_FEATURES and widest > 0.0:
            found = find_horizon(self._points(a.T).T, self._points(b.T).T, sigma, widest, seed=seed)
            prior = (widest / 2.0) ** 2
            self.horizon = found.shift * prior / (prior + found.sd**2)

    def search(self, a: Array, b: Array, sigma: float, hypotheses: int, seed: int) -> PlanarMotion:
        """Return the motion that most of the rays agree with (see the protocol)."""
        points = self._points(a.T).T, self._points(b.T).T
        return ransac_planar_epipoles(*points, sigma, seed=seed, hypotheses=hypotheses)

    def follow(
        self,
        rays: tuple[Array, Array],
        present: Mask | None,
        last: list[PlanarMotion],
        turn: float,
        sigma: float,
    ) -> list[PlanarMotion]:
        """Return the motions near the last ones (see the protocol)."""
        starts = [turned(_epipoles(motion).vector, 0.0, turn) for motion in last]
        pairs, limit = self._seen(*rays), _POINT_SIGMAS * sigma
        return list(refine_epipoles(pairs, starts, sigma, limit=limit, present=present))

    def _seen(self, fixed: Array, current: Array) -> PointPairs:
        """Return the pairs of fixed views and the current one; what is fixed is kept."""
        if self._pairs is None or self._fixed is not fixed:
            self._pairs = PointPairs(self._points(fixed), self._points(current))
            self._fixed = fixed
        else:
            self._pairs.see(self._points(current))
        return self._pairs

    def unmoved(self) -> PlanarMotion:
        """Return no motion at all (see the protocol)."""
        unknown, nobody = np.diag([0.0, np.inf]), np.zeros(0, dtype=np.bool_)
        ahead = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)
        short = Degeneracy.SHORT_BASELINE
        return PlanarEpipoles(0.0, 0.0, unknown, nobody, short, vector=ahead)

    def redirected(
        self, a: Array, b: Array, last: PlanarMotion, turn: float, sigma: float
    ) -> PlanarMotion:
        """Return ``last`` in the best direction (see the protocol)."""
        points = self._points(a.T).T, self._points(b.T).T
        before, now = _bearing_vectors(last.phi), _bearing_vectors(last.phi + turn)
        best = before[_least(squared_point_residuals(*points, now), sigma)].tolist()
        return replace(_epipoles(last), vector=tuple(best))

    def _points(self, rays: Array) -> Array:
        """Return (right, up)/forward (..., 2, N) of rays (..., 3, N), over the horizon."""
        points = image_points(rays)
        points[..., 1, :] -= self.horizon
        return points


def solver_for(name: Solver, camera: CentralCamera) -> PairSolver:
    """Return a solver by name.

    Raises
    ------
    InputError
        A camera that is not perspective, for a solver that works on an image plane.
    """
    perspective = camera.rectilinear and not camera.panoramic
    if name == "planar" or (name == "auto" and not perspective):
        return Calibrated()
    if not perspective:
        raise InputError(
            f"solver '{name}' needs a perspective camera looking ahead, and '{camera.name}' is "
            "not one: choose 'planar' or 'auto'"
        )
    if name in ("fundamental", "essential"):
        from visctrl.schemes.epipolar.general_solver import GeneralMotion

        return GeneralMotion(calibrated=name == "essential")
    return Uncalibrated()


def _epipoles(motion: PlanarMotion) -> PlanarEpipoles:
    assert isinstance(motion, PlanarEpipoles)
    return motion


def _least(squared: Array, sigma: float) -> int:
    """Return which hypothesis has the least squared residuals (H, N), each up to a limit."""
    return int(np.argmin(truncated_squares((_COUNTED_SIGMAS * sigma) ** 2)(squared)))


def _bearing_vectors(phi: float) -> Array:
    """Return the m (H, 4) of baselines in many directions between views a turn ``phi`` apart."""
    angles = np.stack([_DIRECTIONS, _DIRECTIONS + phi], axis=-1)
    m = np.stack([np.cos(angles), np.sin(angles)], axis=-1) / math.sqrt(2.0)
    return np.asarray(m.reshape(-1, 4))


def image_points(rays: Array) -> Array:
    """Return (right, up)/forward (..., 2, N) of rays (..., 3, N)."""
    return np.asarray(rays[..., ::2, :] / np.maximum(rays[..., 1:2, :], _MIN_FORWARD))
