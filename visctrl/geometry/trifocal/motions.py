"""The motions that a calibrated 1D trifocal tensor stands for, in closed form.

Written in e^{iθ1}, e^{iθ2}, e^{iθ3}, the trilinear form of calibrated views has three complex
coefficients k1 of (+,+,−), k2 of (+,−,+), k3 of (−,+,+); that of (+,+,+) vanishes, which is what
the two calibration constraints say. With t = t_y + i t_x, p = e^{−iφ1} and q = e^{−iφ2}

    4 k2 = −t_1*/q,    4 k3 = t_2*/p,    k2 q² + k3 p² = −k1.

The last is a triangle with known sides: it closes in two ways, so there are two motions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from visctrl.geometry.trifocal.tensor import pose_of_view, unit_bearings

Array = NDArray[np.float64]

# Coefficients of e^{iθ} and of e^{−iθ} in (sin θ, cos θ).
_PLUS, _MINUS = np.array([-0.5j, 0.5]), np.array([0.5j, 0.5])


def motions_of_tensor(tensor: ArrayLike) -> Array:
    """Return the motions (16, 2, 3) of a calibrated tensor (8,), every choice of sign included.

    Each is (φ, t_x, t_y) of views 1 and 2, with |t_1| = 1. A bearing is a line, so headings are
    known up to π and positions up to sign; `share_in_front` tells the right choice.
    """
    T = np.asarray(tensor, dtype=np.float64).reshape(2, 2, 2)
    k1 = np.einsum("ijk,i,j,k", T, _PLUS, _PLUS, _MINUS)
    k2 = np.einsum("ijk,i,j,k", T, _PLUS, _MINUS, _PLUS)
    k3 = np.einsum("ijk,i,j,k", T, _MINUS, _PLUS, _PLUS)
    a, b, c = (max(abs(k), 1e-300) for k in (k1, k2, k3))
    opening = np.arccos(np.clip((a * a + b * b - c * c) / (2.0 * a * b), -1.0, 1.0))
    sides = np.array([[opening], [-opening]])
    side = -k1 / a * b * np.exp(1j * sides)
    signs = np.array(list(np.ndindex(2, 2, 2))) * -2.0 + 1.0
    q = np.sqrt(side / k2) * signs[:, 0]
    p = np.sqrt((-k1 - side) / k3) * signs[:, 1]
    t_1, t_2 = (-4.0 * np.conj(k2 * q) * signs[:, 2]), (4.0 * np.conj(k3 * p) * signs[:, 2])
    unit = np.abs(t_1)
    views = [
        np.stack([-np.angle(turn), t.imag / unit, t.real / unit], axis=-1)
        for turn, t in ((p, t_1), (q, t_2))
    ]
    return np.stack(views, axis=-2).reshape(16, 2, 3)


def share_in_front(
    motions: ArrayLike, rays_1: ArrayLike, rays_2: ArrayLike, rays_3: ArrayLike
) -> Array:
    """Return for motions (..., 2, 3) the share of features in front of all three views (...).

    Rays are (N, 2 or 3), as for `trifocal.trilinear`.
    """
    motions = np.asarray(motions, dtype=np.float64)
    target = unit_bearings(rays_3)[0]
    depths = []
    for view, rays in ((0, rays_1), (1, rays_2)):
        pose = pose_of_view(motions[..., view, 0], motions[..., view, 1:])
        bearing = unit_bearings(rays)[0]
        s, c = np.sin(pose[..., 2, None]), np.cos(pose[..., 2, None])
        line = np.stack(
            [c * bearing[:, 0] - s * bearing[:, 1], s * bearing[:, 0] + c * bearing[:, 1]], axis=-1
        )
        centre = pose[..., None, :2]
        # C + λ d = μ w, with w the target's ray: both depths from cross products.
        parallax = _cross(line, target)
        depths.append(-_cross(centre, target) * parallax > 0.0)
        depths.append(-_cross(centre, line) * parallax > 0.0)
    return np.asarray(np.mean(np.all(depths, axis=0), axis=-1), dtype=np.float64)


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
