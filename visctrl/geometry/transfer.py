"""Transfer of bearings: where a feature seen in the initial and target views is seen now.

The trilinear constraint Σ T_ijk u_i v_j w_k = 0 of the 1D trifocal tensor, solved for the
current view. With the target at the origin the feature's ray there is d3 = (sin θ3, cos θ3), its
ray from the initial view, in the target's axes, d1 = (sin α1, cos α1) with α1 = θ1 − φ1. Both
meet at P, and a × b being the planar cross product,

    w = (d3 × d1) (P − C2) = (C1 × d1) d3 − (d3 × d1) C2,        θ2 = atan2(w_x, w_y) + φ2.

No division: a feature at infinity or a vanishing parallax d3 × d1 makes w small, not infinite.
The scale of C1 and C2 is free, as long as it is the same. Bearings are measured clockwise from
forward and headings counter-clockwise from the y axis (rad).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class Transfer(NamedTuple):
    """Bearings in the current view and how they depend on everything.

    bearing : (...) θ2 (rad), determined up to π.
    parallax : (...) d3 × d1, the sine of the angle between the feature's rays in the target and
        the initial view; with the other half of the geometry it is positive in front of both.
    by_initial : (..., 3) ∂θ2/∂(x1, y1, φ1).
    by_current : (..., 3) ∂θ2/∂(x2, y2, φ2).
    by_bearings : (..., 2) ∂θ2/∂(θ1, θ3).
    """

    bearing: Array
    parallax: Array
    by_initial: Array
    by_current: Array
    by_bearings: Array


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
    theta3 = np.asarray(theta3, dtype=np.float64)
    alpha1 = np.asarray(theta1, dtype=np.float64) - phi1
    s1, c1, s3, c3 = np.sin(alpha1), np.cos(alpha1), np.sin(theta3), np.cos(theta3)
    parallax = s3 * c1 - c3 * s1
    reach = x1 * c1 - y1 * s1
    wx, wy = reach * s3 - parallax * x2, reach * c3 - parallax * y2
    square = wx * wx + wy * wy
    inverse = 1.0 / np.where(square > 0.0, square, np.inf)
    # ∂θ2 = (w_y ∂w_x − w_x ∂w_y)/|w|²; for a change along d3 and along C2 that is
    along3 = (wy * s3 - wx * c3) * inverse
    along2 = (wy * x2 - wx * y2) * inverse
    cosine = c3 * c1 + s3 * s1
    by_alpha1 = -(x1 * s1 + y1 * c1) * along3 + cosine * along2
    by_theta3 = reach * (wy * c3 + wx * s3) * inverse - cosine * along2
    shape = np.broadcast_shapes(wx.shape, phi2.shape)
    by_initial = np.empty((*shape, 3))
    by_initial[..., 0], by_initial[..., 1] = c1 * along3, -s1 * along3
    by_initial[..., 2] = -by_alpha1
    by_current = np.empty((*shape, 3))
    by_current[..., 0], by_current[..., 1] = -parallax * wy * inverse, parallax * wx * inverse
    by_current[..., 2] = 1.0
    by_bearings = np.empty((*shape, 2))
    by_bearings[..., 0], by_bearings[..., 1] = by_alpha1, by_theta3
    return Transfer(np.arctan2(wx, wy) + phi2, parallax, by_initial, by_current, by_bearings)
