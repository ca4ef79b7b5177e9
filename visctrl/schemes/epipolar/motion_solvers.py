"""Ways to find the motion between two views, from scratch or near one that is known."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Health
from visctrl.geometry.robust.sampling import truncated_squares
from visctrl.geometry.two_view.essential import Epipole
from visctrl.geometry.two_view.horizon import find_horizon
from visctrl.geometry.two_view.parallax import signed_parallax
from visctrl.geometry.two_view.planar import (
    IDENTICAL,
    PlanarMotion,
    ransac_planar_motion,
    refine_motions,
    sampson_residuals,
    squared_residuals,
)
from visctrl.geometry.two_view.planar_fit import RayPairs
from visctrl.geometry.two_view.planar_residuals import PointPairs
from visctrl.geometry.two_view.planar_residuals import squared_residuals as squared_point_residuals
from visctrl.geometry.two_view.planar_uncalibrated import (
    MINIMUM_FEATURES,
    ONE_PLANE,
    SHORT_BASELINE,
    PlanarEpipoles,
    ransac_planar_epipoles,
    refine_epipoles,
    turned,
)
from visctrl.geometry.two_view.rivals import rival_motion
from visctrl.geometry.two_view.robust_matrices import robust_essential, robust_fundamental
from visctrl.hal.cameras.central import CentralCamera
from visctrl.robots.errors import InputError
from visctrl.robots.unicycle import wrap_angle

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Solver = Literal["auto", "planar-free", "planar", "eight-point"]

#: Features further than this from a followed motion are outliers (standard deviations): of a
#: calibrated camera's rays, and of points, of which one that lies near its epipolar line by
#: chance does more harm.
_RAY_SIGMAS, _POINT_SIGMAS = 8.0, 4.0
#: Directions among which that of a baseline is looked for whose turn is known.
_DIRECTIONS: Array = np.linspace(0.0, math.pi, 12, endpoint=False)
#: A residual counts at most this many standard deviations there.
_COUNTED_SIGMAS = 4.0
#: Parallax (rad) from which a feature has a full vote on the sense of the motion.
_FAR_PARALLAX = 0.005
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
        if motion.health is Health.OK and rival_motion(a, b, motion, sigma, seed=seed) is not None:
            unknown = np.diag([np.inf, np.inf])
            return replace(motion, covariance=unknown, health=Health.DEGENERATE, reason=ONE_PLANE)
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
        return PlanarMotion(0.0, 0.0, unknown, nobody, Health.DEGENERATE, IDENTICAL)

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
        return PlanarEpipoles(0.0, 0.0, unknown, nobody, Health.DEGENERATE, SHORT_BASELINE, ahead)

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
        points = _image_points(rays)
        points[..., 1, :] -= self.horizon
        return points


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
            points = _image_points(a.T).T, _image_points(b.T).T
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
            found.append(self.search(a, b, sigma, hypotheses=256, seed=len(a)))
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


def _upright(epipole: Epipole) -> Epipole:
    """Return an epipole (x, y, 1)-wise as one along (right, forward, up)."""
    order = [0, 2, 1]
    return Epipole(epipole.direction[order], epipole.covariance[np.ix_(order, order)])


def _senses(a: Array, b: Array, theta: float, alpha: float) -> tuple[float, float]:
    """Return the bearing of b's centre and b's heading from the baseline's two line angles."""
    turns = [float(wrap_angle(alpha - theta + half)) for half in (0.0, math.pi)]
    misfits = [float(np.median(np.abs(sampson_residuals(a, b, t, theta)[0]))) for t in turns]
    turn = turns[int(np.argmin(misfits))]
    votes = np.tanh(signed_parallax(a, b, turn, theta) / _FAR_PARALLAX)
    return float(wrap_angle(theta if votes.sum() >= 0.0 else theta + math.pi)), turn


def solver_for(name: Solver, camera: CentralCamera) -> PairSolver:
    """Return a solver by name.

    Raises
    ------
    InputError
        ``planar-free`` for a camera that is not perspective.
    """
    perspective = camera.rectilinear and not camera.panoramic
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


def _image_points(rays: Array) -> Array:
    """Return (right, up)/forward (..., 2, N) of rays (..., 3, N)."""
    return np.asarray(rays[..., ::2, :] / np.maximum(rays[..., 1:2, :], _MIN_FORWARD))
