"""Where the current view lies between two fixed ones, from the features' parallax.

The lines through the epipoles meet at a flat angle when the start lies nearly on the target's
axis, and the noise of the fixed views' epipoles, the same in every tick, then costs far starts
centimetres along it. How far the features themselves have moved tells the same and better: the two
fixed views give each one's distance, in units of their baseline, and the current view is placed
among them. At the target the distances do not matter, for the images coincide.

With everything in the current view's axes and level parts as complex numbers, right + i forward,
let a ray have the level part l u, |u| = 1, and the up component v. The level way X − p to a feature
has the part along the ray Re(u* (X − p)) and the part across it −Im(u* (X − p)); with the height
X_z its residuals sideways and downwards are, in rad and |X − p| being the distance in space,

    r₁ = −Im(u* (X − p))/|X − p|,   r₂ = (v Re(u* (X − p)) − l X_z)/|X − p|.

Their derivatives by p are those of the numerators, and a turn of the view adds l to r₁. Their
variance is that of the ray, of the target's ray, and of the distance |X|, whose relative deviation
is ρ σ: with nᵢ what the numerators are at p = 0,

    σ² (1 + (|X|² + (ρ nᵢ)²)/|X − p|²).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.robust.least_squares import Options, Solved, gauss_newton
from visctrl.geometry.robust.losses import cauchy
from visctrl.geometry.robust.scale import upper_mad_sd

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Mask = NDArray[np.bool_]

#: Features whose distance is less certain than this part of it are left out.
_MAX_RANGE_SD = 0.3
#: Fewer features than this do not place a view.
_LEAST_FEATURES = 8
#: Steps at most, and the one, as a part of the distance from the target, after which all is said.
_OPTIONS = Options(iterations=4, converged=0.01**2)
#: Least information in one direction as a part of the most in any.
_REGULAR = 1e-12
#: Scale of the Cauchy kernel, in standard deviations of a residual.
_KERNEL_SIGMAS = 2.0
#: What the fixed views' own geometry costs, as a part of the distance from the target.
_FIXED_SHARE = 0.01


class Placed(NamedTuple):
    """Position of a view in the target's frame, in baselines of the fixed views.

    variance : of x, of both together and of y.
    """

    x: float
    y: float
    variance: tuple[float, float, float]


class _Seen(NamedTuple):
    """Features as the current view sees them, in its own axes.

    level, up : (N,), l and the up component of a ray.
    towards : (N,), u*.
    points : (N,), X, the level part.
    lifted : (N,), l X_z.
    height2 : (N,), X_z².
    spread : (2 N,), |X|² + (ρ nᵢ)², sideways first.
    """

    level: Array
    up: Array
    towards: Complex
    points: Complex
    lifted: Array
    height2: Array
    spread: Array


class Structure:
    """Features that two fixed views, the target and a reference, place in space.

    Parameters
    ----------
    fixed : (2 or more, 3, N) array
        Unit rays (right, forward, up) of the same features in the target and the reference view;
        further views do not matter.
    pose : (x, y, phi)
        Of the reference view in the target's frame, |(x, y)| = 1.
    present : (2 or more, N) array or None
        Features that the views have; None for all.
    """

    def __init__(
        self, fixed: Array, pose: tuple[float, float, float], present: Mask | None = None
    ) -> None:
        self._made_of = (fixed, pose)
        x, y, phi = pose
        s, c = math.sin(phi), math.cos(phi)
        target, reference = fixed[:2]
        (a0, a1, a2), (r, f, b2) = target, reference
        b0, b1 = c * r - s * f, s * r + c * f
        # λ a − μ b = (x, y, 0), in the least-squares sense, by n = a × b.
        n0, n1, n2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
        sine2 = np.maximum(n0 * n0 + n1 * n1 + n2 * n2, 1e-18)
        here = (y * b2 * n0 - x * b2 * n1 + (x * b1 - y * b0) * n2) / sine2
        there = (y * a2 * n0 - x * a2 * n1 + (x * a1 - y * a0) * n2) / sine2
        self._ahead = (here > 0.0) & (there > 0.0)
        if present is not None:
            self._ahead &= present[0] & present[1]
        #: ρ, the relative deviation of the distance in σ.
        self._doubt = np.hypot(here, there) / (np.sqrt(sine2) * np.where(self._ahead, here, 1.0))
        level = np.empty(len(here), dtype=np.complex128)
        np.multiply(here, a0, out=level.real)
        np.multiply(here, a1, out=level.imag)
        self._points, self._heights, self._range2 = level, here * a2, here * here
        self._limit = math.nan
        self._select(math.inf)

    def stands_for(self, fixed: Array, pose: tuple[float, float, float]) -> bool:
        """Whether it was made of the very same array of rays, and of this pose."""
        return self._made_of[0] is fixed and self._made_of[1] == pose

    def _select(self, limit: float) -> None:
        """Choose the features whose ρ is under a limit."""
        self._limit = limit
        good = self._ahead & (self._doubt < limit)
        which = np.flatnonzero(good)
        self._which = None if len(which) == len(good) else which
        self._chosen = _Chosen(
            self._points[which], self._heights[which], self._range2[which], self._doubt[which]
        )

    def place(
        self, current: Array, start: tuple[float, float, float], sigma: float
    ) -> Placed | None:
        """Return where the current view is, or None where the features do not tell.

        Parameters
        ----------
        current : (3, N) array
            Unit rays of the features in the current view.
        start : (x, y, phi)
            About where the current view is, in baselines.
        sigma : float
            Standard deviation of one ray's direction (rad).
        """
        if self._limit != _MAX_RANGE_SD / sigma:
            self._select(_MAX_RANGE_SD / sigma)
        if len(self._chosen.points) < _LEAST_FEATURES:
            return None
        x, y, phi = start
        s, c = math.sin(phi), math.cos(phi)
        rays = current if self._which is None else current.take(self._which, axis=1)
        seen = self._chosen.seen(rays, complex(c, -s))
        place, at, _, _ = gauss_newton(
            lambda place: _linearised(seen, place, sigma),
            _step,
            lambda place, step: place - step,
            complex(c * x + s * y, c * y - s * x),
            _OPTIONS,
        )
        if at.solved is None:
            return None
        right, forward, variance = place.real, place.imag, at.solved[1]
        own = _FIXED_SHARE**2 * (right**2 + forward**2)
        rr, rf, ff = variance
        # From the current view's axes into the target's frame.
        return Placed(
            c * right - s * forward,
            s * right + c * forward,
            (
                c * c * rr - 2.0 * s * c * rf + s * s * ff + own,
                s * c * (rr - ff) + (c * c - s * s) * rf,
                s * s * rr + 2.0 * s * c * rf + c * c * ff + own,
            ),
        )


class _Place(NamedTuple):
    """A place, right + i forward, and the step from there with its variances if they are known."""

    place: complex
    solved: tuple[tuple[float, float], tuple[float, float, float]] | None


def _linearised(seen: _Seen, place: complex, sigma: float) -> _Place:
    return _Place(place, _solve(*_normal_equations(seen, place.real, place.imag, sigma)))


def _step(at: _Place) -> Solved[complex]:
    """Return the step; its gain is its squared length as a part of the distance."""
    if at.solved is None:
        return Solved(0j, -1.0)
    step = complex(*at.solved[0])
    right, forward = at.place.real - step.real, at.place.imag - step.imag
    distance2 = max(right**2 + forward**2, 1e-300)
    return Solved(step, (step.real**2 + step.imag**2) / distance2)


class _Chosen(NamedTuple):
    """Features that do place a view: X, level and up, |X|² and ρ, in the target's frame."""

    points: Complex
    heights: Array
    range2: Array
    doubt: Array

    def seen(self, rays: Array, turn: complex) -> _Seen:
        """Return them in the axes of a view with these rays (3, N); ``turn`` takes them there."""
        right, forward, up = rays
        towards = np.empty(len(right), dtype=np.complex128)
        level = np.maximum(np.hypot(right, forward), 1e-9)
        np.divide(right, level, out=towards.real)
        np.divide(forward, -level, out=towards.imag)
        points = self.points * turn
        lifted = level * self.heights
        across = _across(towards * points, up, lifted)
        across *= np.concatenate((self.doubt, self.doubt))
        spread = across * across
        spread += np.concatenate((self.range2, self.range2))
        return _Seen(level, up, towards, points, lifted, self.heights * self.heights, spread)


def _across(seen: Complex, up: Array, lifted: Array) -> Array:
    """Return the residuals' numerators (2 N,) of u* times the level ways ``seen``."""
    count = len(up)
    across = np.empty(2 * count)
    np.negative(seen.imag, out=across[:count])
    np.multiply(seen.real, up, out=across[count:])
    across[count:] -= lifted
    return across


def _normal_equations(
    seen: _Seen, right: float, forward: float, sigma: float
) -> tuple[list[list[float]], float]:
    """Return the weighted products (4, 4) of the derivatives by p and turn and of the residuals.

    They are in units of (σ κ)², which is returned as well: κ ≥ 1 is how much larger than promised
    the residuals are. The derivatives have the opposite sign.
    """
    way = seen.towards * (seen.points - complex(right, forward))
    count = len(way)
    distance2 = way.real * way.real
    distance2 += way.imag * way.imag
    distance2 += seen.height2
    rows = np.empty((4, 2 * count))
    cosine, sine = np.negative(seen.towards.imag, out=rows[0, :count]), seen.towards.real
    np.negative(sine, out=rows[1, :count])
    np.multiply(sine, seen.up, out=rows[0, count:])
    np.multiply(cosine, seen.up, out=rows[1, count:])
    np.multiply(seen.level, -np.sqrt(distance2), out=rows[2, :count])
    rows[2, count:] = 0.0
    rows[3] = _across(way, seen.up, seen.lifted)
    scale = np.concatenate((distance2, distance2))
    scale += seen.spread
    rows *= 1.0 / np.sqrt(scale)
    residual = rows[3]
    spread = max(sigma, upper_mad_sd(residual))
    scaled = residual * (1.0 / (_KERNEL_SIGMAS * spread))
    scaled *= scaled
    weighted = rows * cauchy(scaled)
    return weighted.dot(rows.T).tolist(), spread**2


def _solve(
    products: list[list[float]], unit: float
) -> tuple[tuple[float, float], tuple[float, float, float]] | None:
    """Return the step of p (right, forward) and its variances, the turn eliminated.

    None where the turn cannot be told from a step, or one step from another.
    """
    (rr, rf, rt, _), (_, ff, ft, _), (_, _, tt, _), (g_r, g_f, g_t, _) = products
    if tt <= _REGULAR * (rr + ff):
        return None
    a, b, d = rr - rt * rt / tt, rf - rt * ft / tt, ff - ft * ft / tt
    det = a * d - b * b
    if det <= _REGULAR * (a + d) * (a + d) or a + d <= _REGULAR * (rr + ff):
        return None
    u, v = g_r - rt * g_t / tt, g_f - ft * g_t / tt
    step = (-(d * u - b * v) / det, -(a * v - b * u) / det)
    return step, (d * unit / det, -b * unit / det, a * unit / det)
