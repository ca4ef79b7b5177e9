"""The 1D trifocal tensor of three bearing-only views in the plane: its algebra.

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


class Trilinear(NamedTuple):
    """The trilinear relation of N features as linear forms in the tensor's k coordinates.

    error : (..., N, k), rows d with d·z the algebraic error; k = 8, z = T as it is built.
    gradient : (3, ..., N, k), its derivatives by the features' directions in views 1, 2, 3 (rad).
    """

    error: Array
    gradient: Array

    def __len__(self) -> int:
        return int(self.error.shape[-2])

    def within(self, basis: Array) -> Trilinear:
        """Return the relation for tensors T = basis·z, with basis (8, k)."""
        return Trilinear(self.error @ basis, self.gradient @ basis)

    def take(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> Trilinear:
        """Return the relation of some of the features (no leading axes)."""
        return Trilinear(self.error[which], self.gradient[:, which])


def unit_bearings(rays: ArrayLike) -> tuple[Array, Array]:
    """Return bearings (..., 2) as (sin θ, cos θ) of rays (..., 2 or 3), and how level each is.

    The second array is the length of a unit ray's horizontal part (1 for plain bearings): the
    direction's error grows by its inverse when it is read as a bearing.
    """
    level = np.asarray(rays, dtype=np.float64)[..., :2]
    norm = np.maximum(np.linalg.norm(level, axis=-1), 1e-9)
    return level / norm[..., None], norm


def trilinear(rays_1: ArrayLike, rays_2: ArrayLike, rays_3: ArrayLike) -> Trilinear:
    """Return the trilinear relation of features (..., N, 2 or 3) seen in the three views.

    Rays are bearings (sin θ, cos θ), or unit rays (right, forward, up) whose bearings are
    weighted by how level they are.
    """
    (u, nu), (v, nv), (w, nw) = (unit_bearings(r) for r in (rays_1, rays_2, rays_3))
    du, dv, dw = (_quarter_turn(b) / n[..., None] for b, n in ((u, nu), (v, nv), (w, nw)))
    return Trilinear(
        _outer(u, v, w), np.stack([_outer(du, v, w), _outer(u, dv, w), _outer(u, v, dw)])
    )


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


def sampson_jacobian(relation: Trilinear, tensor: Array) -> tuple[Array, Array]:
    """Return the residuals (N,) of one tensor (k,), and their derivatives (N, k) by it."""
    a, b, c = slopes = relation.gradient @ tensor
    inverse = 1.0 / np.sqrt(np.maximum(a * a + b * b + c * c, 1e-24))
    residual = (relation.error @ tensor) * inverse
    bend = (slopes * (residual * inverse))[..., None] * relation.gradient
    jacobian = (relation.error - bend[0] - bend[1] - bend[2]) * inverse[:, None]
    return residual, jacobian


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
    return np.asarray(np.tensordot(view, _BILINEAR, axes=([-1], [1])))


def initial_view_basis(view_2: ArrayLike) -> Array:
    """Return (..., 8, 4): with view 2 known, T is linear in the initial view's parameters."""
    view = np.asarray(view_2, dtype=np.float64)
    return np.asarray(np.tensordot(view, _BILINEAR, axes=([-1], [2])))


def normalised(tensor: ArrayLike) -> Array:
    """Return tensors (..., 8) over their T121, which tends to t_y1 and is never 0 in a task."""
    T = np.asarray(tensor, dtype=np.float64)
    return np.asarray(T / T[..., T121, None])


def normalised_covariance(tensor: Array, covariance: Array) -> Array:
    """Return the first-order covariance (8, 8) of `normalised` for one tensor's covariance."""
    J = (np.eye(8) - np.outer(tensor / tensor[T121], np.eye(8)[T121])) / tensor[T121]
    return np.asarray(J @ covariance @ J.T)


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


def _quarter_turn(bearing: Array) -> Array:
    """Return the derivative (cos θ, −sin θ) of bearings (sin θ, cos θ)."""
    return np.stack([bearing[..., 1], -bearing[..., 0]], axis=-1)


def _outer(u: Array, v: Array, w: Array) -> Array:
    """Return u ⊗ v ⊗ w (..., 8) of bearings (..., 2)."""
    product = u[..., :, None, None] * v[..., None, :, None] * w[..., None, None, :]
    return np.asarray(product.reshape(*product.shape[:-3], 8))
