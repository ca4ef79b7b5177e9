"""Transfer of bearings: where a feature seen in the initial and target views is seen now.

The trilinear constraint Σ T_ijk u_i v_j w_k = 0 of the 1D trifocal tensor, solved for the
current view. With the target at the origin the feature's ray there is d3 = (sin θ3, cos θ3), its
ray from the initial view, in the target's axes, d1 = (sin α1, cos α1) with α1 = θ1 − φ1. Both
meet at P, and a × b being the planar cross product,

    w = (d3 × d1) (P − C2) = (C1 × d1) d3 − (d3 × d1) C2,        θ2 = atan2(w_x, w_y) + φ2.

No division: a feature at infinity or a vanishing parallax d3 × d1 makes w small, not infinite.
The scale of C1 and C2 is free, as long as it is the same. Bearings are measured clockwise from
forward and headings counter-clockwise from the y axis (rad).

Written in complex numbers, y + i x for a vector (x, y), a ray is exp(iθ), d3 × d1 the imaginary
part of exp(i(θ3 − α1)), and a change of w turns its direction by the imaginary part of ∂w/w.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: In place of a point that nobody sees, whose direction does not change.
_FAR = 1e300


class Transfer(NamedTuple):
    """Bearings in the current view and how they depend on everything.

    bearing : (...) θ2 (rad), determined up to π.
    parallax : (...) d3 × d1, the sine of the angle between the feature's rays in the target and
        the initial view; with the other half of the geometry it is positive in front of both.
    slopes : (8, ...) ∂θ2/∂(x1, y1, φ1, x2, y2, φ2, θ1, θ3).
    """

    bearing: Array
    parallax: Array
    slopes: Array

    @property
    def by_initial(self) -> Array:
        """(3, ...) ∂θ2/∂(x1, y1, φ1)."""
        return self.slopes[:3]

    @property
    def by_current(self) -> Array:
        """(3, ...) ∂θ2/∂(x2, y2, φ2)."""
        return self.slopes[3:6]

    @property
    def by_bearings(self) -> Array:
        """(2, ...) ∂θ2/∂(θ1, θ3)."""
        return self.slopes[6:]


def bearings(rays: ArrayLike) -> Array:
    """Return the bearings (..., ) of robot rays (..., 3), clockwise from forward (rad)."""
    rays = np.asarray(rays, dtype=np.float64)
    return np.asarray(np.arctan2(rays[..., 0], rays[..., 1]), dtype=np.float64)


def wrap_half_turn(angle: ArrayLike) -> Array:
    """Return angles (rad) modulo π, in [−π/2, π/2): the difference of two undirected lines."""
    angle = np.asarray(angle, dtype=np.float64)
    return np.asarray(np.remainder(angle + np.pi / 2.0, np.pi) - np.pi / 2.0, dtype=np.float64)


def transfer_bearing(
    initial: ArrayLike, current: ArrayLike, theta1: ArrayLike, theta3: ArrayLike
) -> Transfer:
    """Return the bearing in the current view of features seen in the other two.

    Parameters
    ----------
    initial, current : (..., 3) arrays
        C1 and C2 = (x, y, φ) in the target's frame; x, y in any common unit.
    theta1, theta3 : (...) arrays
        Bearings in the initial and the target view (rad), broadcast against the poses' leading
        axes.
    """
    initial = np.asarray(initial, dtype=np.float64)
    current = np.asarray(current, dtype=np.float64)
    x1, y1, phi1 = initial[..., 0], initial[..., 1], initial[..., 2]
    x2, y2, phi2 = current[..., 0], current[..., 1], current[..., 2]
    ray3 = np.exp(1j * np.asarray(theta3, dtype=np.float64))
    ray1 = np.exp(1j * (np.asarray(theta1, dtype=np.float64) - phi1))
    between = ray3 * ray1.conj()
    parallax, cosine = between.imag, between.real
    # x1 c1 − y1 s1, the reach C1 × d1, and x1 s1 + y1 c1.
    arm = (x1 + 1j * y1) * ray1
    centre = y2 + 1j * x2
    w = arm.real * ray3 - parallax * centre
    inverse = 1.0 / np.where(w == 0.0, _FAR, w)
    along3, along2 = ray3 * inverse, (centre * inverse).imag
    slopes = np.empty((8, *np.broadcast_shapes(w.shape, phi2.shape)))
    slopes[0], slopes[1] = ray1.real * along3.imag, -ray1.imag * along3.imag
    slopes[6] = cosine * along2 - arm.imag * along3.imag
    slopes[2] = -slopes[6]
    slopes[3], slopes[4], slopes[5] = -parallax * inverse.real, -parallax * inverse.imag, 1.0
    slopes[7] = arm.real * along3.real - cosine * along2
    return Transfer(np.arctan2(w.imag, w.real) + phi2, parallax, slopes)
