"""Where the current view lies between two fixed ones, from the features' parallax.

The lines through the epipoles meet at a flat angle when the start lies nearly on the target's
axis, and the noise of the fixed views' epipoles, the same in every tick, then costs far starts
centimetres along it. How far the features themselves have moved tells the same and better: the two
fixed views give each one's distance, in units of their baseline, and the current view is placed
among them. At the target the distances do not matter, for the images coincide.

With everything in the current view's axes, a ray (r, f, u), its level part l = √(r² + f²) and
s, c = r/l, f/l, the tangents across the ray are t₁ = (c, −s, 0) and t₂ = (s u, c u, −l). A
feature at X and the view at p have the residuals, in rad,

    tᵢ · (X − p)/|X − p|,

with the derivatives −tᵢ/|X − p| by p and (l, 0) by a turn of the view. Their variance is that of
the ray, of the target's ray, and of the distance |X|, whose deviation is ρ |X| σ:

    σ² (1 + (|X|² + (ρ tᵢ · X)²)/|X − p|²).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Features whose distance is less certain than this part of it are left out.
_MAX_RANGE_SD = 0.3
#: Fewer features than this do not place a view.
_LEAST_FEATURES = 8
#: Steps at most, and the one, as a part of the distance from the target, after which all is said.
_STEPS, _STILL = 4, 0.01
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

    level : (N,), l.
    points : (3, N), X.
    tangents : (2, 2, N), the level parts of t₁ and t₂, as components.
    lifted : (N,), the part of t₂ · X that is due to heights.
    spread : (2, N), |X|² + (ρ tᵢ · X)².
    """

    level: Array
    points: Array
    tangents: Array
    lifted: Array
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
        self._points = here * target
        self._range2 = here * here
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
        self._chosen = (self._points, self._range2, self._doubt)
        if self._which is not None:
            self._chosen = (self._points[:, which], self._range2[which], self._doubt[which])

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
        if len(self._chosen[1]) < _LEAST_FEATURES:
            return None
        x, y, phi = start
        s, c = math.sin(phi), math.cos(phi)
        seen = self._see(current, s, c)
        right, forward = c * x + s * y, c * y - s * x
        variance = (0.0, 0.0, 0.0)
        for _ in range(_STEPS):
            solved = _solve(*_normal_equations(seen, right, forward, sigma))
            if solved is None:
                return None
            (step_right, step_forward), variance = solved
            right, forward = right - step_right, forward - step_forward
            if step_right**2 + step_forward**2 < _STILL**2 * (right**2 + forward**2):
                break
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

    def _see(self, current: Array, s: float, c: float) -> _Seen:
        """Return the chosen features in the axes of the current view."""
        points, range2, doubt = self._chosen
        rays = current if self._which is None else current.take(self._which, axis=1)
        turned = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ points
        level, up = np.maximum(np.hypot(rays[0], rays[1]), 1e-9), rays[2]
        along = rays[:2] / level
        tangents = np.empty((2, 2, len(level)))
        tangents[0, 0] = along[1]
        np.negative(along[0], out=tangents[0, 1])
        np.multiply(along, up, out=tangents[1])
        lifted = level * turned[2]
        loose = _across(tangents, turned[:2], lifted) * doubt
        return _Seen(level, turned, tangents, lifted, loose * loose + range2)


def _across(tangents: Array, way: Array, lifted: Array) -> Array:
    """Return the products (2, N) of both tangents with level ways (2, N) and heights."""
    products = tangents * way
    across = products[:, 0] + products[:, 1]
    across[1] -= lifted
    return np.asarray(across)


def _normal_equations(
    seen: _Seen, right: float, forward: float, sigma: float
) -> tuple[list[list[float]], float]:
    """Return the weighted products (4, 4) of the derivatives by p and turn and of the residuals.

    They are in units of (σ κ)², which is returned as well: κ ≥ 1 is how much larger than promised
    the residuals are.
    """
    way = seen.points - np.array([[right], [forward], [0.0]])
    distance2 = np.einsum("in,in->n", way, way)
    scale = 1.0 / np.sqrt(seen.spread + distance2)
    rows = np.zeros((4, *scale.shape))
    rows[:2] = seen.tangents.swapaxes(0, 1)
    np.multiply(seen.level, -np.sqrt(distance2), out=rows[2, 0])
    rows[3] = _across(seen.tangents, way[:2], seen.lifted)
    rows *= scale
    residual = rows[3]
    middle = residual.size // 2
    usual = float(np.partition(np.abs(residual), middle, axis=None)[middle])
    spread = max(sigma, 1.4826 * usual)
    scaled = residual * (1.0 / (_KERNEL_SIGMAS * spread))
    weighted = (rows / (1.0 + scaled * scaled)).reshape(4, -1)
    return (weighted @ rows.reshape(4, -1).T).tolist(), spread**2


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
