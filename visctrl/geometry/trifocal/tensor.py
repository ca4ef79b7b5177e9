"""The 1D trifocal tensor of three bearing-only views in the plane: its algebra.

Products of single small matrices are written with `dot`, which takes half the time of ``@``.

Views: 1 initial, 2 current, 3 target. A tensor is an array (..., 8) of its elements T_ijk in
the order 111, 112, 121, 122, 211, 212, 221, 222; Σ T_ijk u_i v_j w_k = 0 for u, v, w the
bearing (sin θ, cos θ) of one feature in views 1, 2, 3, θ clockwise from forward (3.1).

With the target's pose as origin, view n has the heading φn and sees the target at
t_n = (t_xn, t_yn) in its own axes (right, forward). Everything broadcasts over leading axes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: Names of the elements in the order of the arrays.
ELEMENTS = ("T111", "T112", "T121", "T122", "T211", "T212", "T221", "T222")
T111, T112, T121, T122, T211, T212, T221, T222 = range(8)

#: (2, 8): rows c with c·T = 0 for calibrated views, −T111 + T122 + T212 + T221 = 0 and
#: T112 + T121 + T211 − T222 = 0 (3.2, the sign of T222 corrected), of unit length.
CALIBRATION = 0.5 * np.array(
    [[-1.0, 0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0], [0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 0.0, -1.0]]
)
#: (8, 6): orthonormal columns that span the calibrated tensors.
CALIBRATED = np.linalg.svd(CALIBRATION)[2][2:].T.copy()
#: (8, 8): every tensor, calibrated or not.
UNCALIBRATED = np.eye(8)


def _bilinear() -> Array:
    """Return B (8, 4, 4) with T_k = Σ B_kab p1_a p2_b, p_n = (cos φn, sin φn, t_xn, t_yn)."""
    c, s, x, y = range(4)
    B = np.zeros((8, 4, 4))
    terms = {
        T111: ((y, s, 1), (s, y, -1)),
        T112: ((y, c, -1), (c, y, 1)),
        T121: ((y, c, 1), (s, x, 1)),
        T122: ((y, s, 1), (c, x, -1)),
        T211: ((x, s, -1), (c, y, -1)),
        T212: ((x, c, 1), (s, y, -1)),
        T221: ((x, c, -1), (c, x, 1)),
        T222: ((x, s, -1), (s, x, 1)),
    }
    for element, products in terms.items():
        for first, second, sign in products:
            B[element, first, second] = sign
    return B


_BILINEAR = _bilinear()
#: The same as linear maps (4, 32) of the first and of the second view's parameters.
_BY_FIRST = np.moveaxis(_BILINEAR, 1, 0).reshape(4, 32)
_BY_SECOND = np.moveaxis(_BILINEAR, 2, 0).reshape(4, 32)


class Trilinear(NamedTuple):
    """The trilinear relation of N features as linear forms in the tensor's k coordinates.

    forms : (k, 4, ..., N), ``error`` and ``gradient`` in one; k = 8, z = T as it is built. The
        features come last: array operations then run over them, whatever k is.
    """

    forms: Array

    def __len__(self) -> int:
        return int(self.forms.shape[-1])

    @property
    def error(self) -> Array:
        """(..., N, k): rows d with d·z the algebraic error."""
        return np.moveaxis(self.forms[:, 0], 0, -1)

    @property
    def gradient(self) -> Array:
        """(3, ..., N, k): its derivatives by the directions in views 1, 3, 2 (rad)."""
        return np.moveaxis(self.forms[:, 1:], 0, -1)

    def within(self, basis: Array) -> Trilinear:
        """Return the relation for tensors T = basis·z, with basis (8, k)."""
        forms = self.forms
        within = basis.T.dot(forms.reshape(len(forms), -1))
        return Trilinear(within.reshape(-1, *forms.shape[1:]))

    def take(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> Trilinear:
        """Return the relation of some of the features."""
        return Trilinear(self.forms[..., which])


class FixedForms:
    """What the initial and target views contribute to every current view's trilinear relation.

    Parameters
    ----------
    rays_1, rays_3 : (..., N, 2 or 3) arrays
        Bearings (sin θ, cos θ), or unit rays (right, forward, up) whose bearings are weighted
        by how level they are.
    """

    def __init__(self, rays_1: ArrayLike, rays_3: ArrayLike) -> None:
        (u, du), (w, dw) = directions(rays_1), directions(rays_3)
        # (2, 1, 2, 4, ..., N): u ⊗ w, its derivatives, and u ⊗ w once more for that by v.
        pairs = ((u, w), (du, w), (u, dw), (u, w))
        self._pairs = np.stack([a[:, None] * b for a, b in pairs], axis=2)[:, None]

    def relation(self, rays_2: ArrayLike) -> Trilinear:
        """Return the trilinear relation with the current view's rays (..., N, 2 or 3)."""
        v, dv = directions(rays_2)
        factors = np.empty((2, 1, 4, *v.shape[1:]))
        factors[:, 0, :3], factors[:, 0, 3] = v[:, None], dv
        forms = self._pairs * factors
        return Trilinear(forms.reshape(8, *forms.shape[3:]))


def unit_bearings(rays: ArrayLike) -> tuple[Array, Array]:
    """Return bearings (..., 2) as (sin θ, cos θ) of rays (..., 2 or 3), and how level each is.

    The second array is the length of a unit ray's horizontal part (1 for plain bearings): the
    direction's error grows by its inverse when it is read as a bearing.
    """
    level = np.asarray(rays, dtype=np.float64)[..., :2]
    square = level * level
    norm = np.sqrt(np.maximum(square[..., 0] + square[..., 1], 1e-18))
    return level / norm[..., None], norm


def trilinear(rays_1: ArrayLike, rays_2: ArrayLike, rays_3: ArrayLike) -> Trilinear:
    """Return the trilinear relation of features (..., N, 2 or 3) seen in the three views.

    Rays are bearings (sin θ, cos θ), or unit rays (right, forward, up) whose bearings are
    weighted by how level they are.
    """
    return FixedForms(rays_1, rays_3).relation(rays_2)


def sampson_residuals(relation: Trilinear, tensor: ArrayLike) -> Array:
    """Return the residuals (..., N) in rad of tensors (..., k) (no leading axes in relation).

    The algebraic error over the norm of its gradient by the three directions; it does not
    depend on the tensor's scale, and its standard deviation is that of one direction.
    """
    T = np.asarray(tensor, dtype=np.float64)
    gradient2 = np.zeros(())
    for by_view in relation.gradient:
        gradient2 = gradient2 + np.square(T @ by_view.T)
    return np.asarray((T @ relation.error.T) / np.sqrt(np.maximum(gradient2, 1e-24)))


class Linearised(NamedTuple):
    """Sampson residuals of one tensor and how they depend on it.

    residual : (N,) in rad.
    slopes : (4, N): the derivative of residual n by z is Σ_i slopes[i, n] forms[:, i, n],
        whatever the coordinates z that the forms are expressed in.
    """

    residual: Array
    slopes: Array

    def jacobian(self, relation: Trilinear) -> Array:
        """Return the derivatives (k, N) by the tensor's coordinates in ``relation``."""
        return np.asarray(np.einsum("kin,in->kn", relation.forms, self.slopes))


def linearised(relation: Trilinear, tensor: Array) -> Linearised:
    """Return the Sampson residuals (no leading axes) of one tensor (k,), with their slopes."""
    forms = relation.forms
    values = tensor.dot(forms.reshape(len(tensor), -1)).reshape(forms.shape[1:])
    square = values * values
    inverse = 1.0 / np.sqrt(np.maximum(square[1] + square[2] + square[3], 1e-24))
    residual = values[0] * inverse
    slopes = values * (-residual * inverse * inverse)
    slopes[0] = inverse
    return Linearised(residual, slopes)


def view_parameters(heading: ArrayLike, target: ArrayLike) -> Array:
    """Return (..., 4) as (cos φ, sin φ, t_x, t_y) of a view's heading and target position."""
    phi, t = np.asarray(heading, dtype=np.float64), np.asarray(target, dtype=np.float64)
    shape = np.broadcast_shapes(phi.shape, t.shape[:-1])
    out = np.empty((*shape, 4))
    out[..., 0], out[..., 1], out[..., 2:] = np.cos(phi), np.sin(phi), t
    return out


def target_in_view(pose: ArrayLike) -> Array:
    """Return t (..., 2), the target's (right, forward) position seen from poses (..., 3)."""
    x, y, phi = np.moveaxis(np.asarray(pose, dtype=np.float64), -1, 0)
    s, c = np.sin(phi), np.cos(phi)
    return np.stack([-x * c - y * s, x * s - y * c], axis=-1)


def pose_of_view(heading: ArrayLike, target: ArrayLike) -> Array:
    """Return the pose (..., 3) of a view: the inverse of `target_in_view`."""
    phi, t = np.asarray(heading, dtype=np.float64), np.asarray(target, dtype=np.float64)
    s, c = np.sin(phi), np.cos(phi)
    x, y = -c * t[..., 0] + s * t[..., 1], -s * t[..., 0] - c * t[..., 1]
    return np.stack(np.broadcast_arrays(x, y, phi), axis=-1)


def tensor_of_views(view_1: ArrayLike, view_2: ArrayLike) -> Array:
    """Return the tensors (..., 8) of view parameters (..., 4) (see `view_parameters`): (3.2)."""
    G = current_view_basis(view_1)
    return np.asarray((G @ np.asarray(view_2, dtype=np.float64)[..., None])[..., 0])


def tensor_from_poses(pose_1: ArrayLike, pose_2: ArrayLike) -> Array:
    """Return the metric tensors (..., 8) of poses (..., 3), the target at the origin: (3.2)."""
    views = []
    for pose in (pose_1, pose_2):
        pose = np.asarray(pose, dtype=np.float64)
        views.append(view_parameters(pose[..., 2], target_in_view(pose)))
    return tensor_of_views(*views)


def current_view_basis(view_1: ArrayLike) -> Array:
    """Return G (..., 8, 4): with view 1 known, T = G·p2 is linear in the current view."""
    view = np.asarray(view_1, dtype=np.float64)
    return np.asarray(view.dot(_BY_FIRST).reshape(*view.shape[:-1], 8, 4))


def initial_view_basis(view_2: ArrayLike) -> Array:
    """Return (..., 8, 4): with view 2 known, T is linear in the initial view's parameters."""
    view = np.asarray(view_2, dtype=np.float64)
    return np.asarray(view.dot(_BY_SECOND).reshape(*view.shape[:-1], 8, 4))


def normalised(tensor: ArrayLike) -> Array:
    """Return tensors (..., 8) over their T121, which tends to t_y1 and is never 0 in a task."""
    T = np.asarray(tensor, dtype=np.float64)
    return np.asarray(T / T[..., T121 : T121 + 1])


def normalised_covariance(tensor: Array, covariance: Array) -> Array:
    """Return the first-order covariance (8, 8) of `normalised` for one tensor's covariance."""
    first = float(tensor[T121])
    ratio = tensor / first
    rows = covariance - ratio[:, None] * covariance[T121]
    return np.asarray((rows - rows[:, T121, None] * ratio) / first**2)


def dynamics(
    tensor: ArrayLike,
    phi_1: ArrayLike,
    scale: ArrayLike,
    v: ArrayLike,
    omega: ArrayLike,
    offset: float = 0.0,
) -> Array:
    """Return the rates (..., 8) of tensor elements divided by a constant: (3.5).

    Parameters
    ----------
    tensor : (..., 8) array
        Elements divided by ``scale``.
    phi_1 : (...) array
        Heading of the initial view (rad).
    scale : (...) array
        What the metric elements were divided by, T_N (m).
    v, omega : (...) arrays
        Forward speed (m/s) and turning rate (rad/s).
    offset : float
        Camera ahead of the axle, ℓ (m); (3.5) has none. It adds the camera's sideways speed.
    """
    T = np.asarray(tensor, dtype=np.float64)
    s, c = np.sin(phi_1) / scale, np.cos(phi_1) / scale
    v, omega = np.asarray(v, dtype=np.float64), np.asarray(omega, dtype=np.float64)
    left = offset * omega
    rates = [
        s * v + T[..., T121] * omega,
        -c * v + T[..., T122] * omega,
        -T[..., T111] * omega + s * left,
        -T[..., T112] * omega - c * left,
        c * v + T[..., T221] * omega,
        s * v + T[..., T222] * omega,
        -T[..., T211] * omega + c * left,
        -T[..., T212] * omega + s * left,
    ]
    return np.stack(np.broadcast_arrays(*rates), axis=-1)


def directions(rays: ArrayLike) -> tuple[Array, Array]:
    """Return bearings (2, ..., N) as (sin θ, cos θ), and their derivatives by the direction."""
    rays = np.asarray(rays, dtype=np.float64)
    right, forward = rays[..., 0], rays[..., 1]
    inverse = 1.0 / np.sqrt(np.maximum(right * right + forward * forward, 1e-18))
    bearing, turned = np.empty((2, 2, *inverse.shape))
    np.multiply(right, inverse, out=bearing[0])
    np.multiply(forward, inverse, out=bearing[1])
    np.multiply(bearing[1], inverse, out=turned[0])
    np.multiply(bearing[0], -inverse, out=turned[1])
    return bearing, turned
