"""The trifocal tensor of three views of points under planar motion: its algebra and estimation.

Views: 1 initial, 2 current, 3 target, the reference. Image axes are 1 right, 2 up, 3 forward;
under planar motion 12 of the 27 elements T_ijk (first index: target, second: initial, third:
current view) differ from zero (1.9):

    T_ijk = R1_ji t2_k − t1_j R2_ki,

with R_n the turn from the target's axes into those of view n, and t_n the target's position in
view n's axes. T212 and T232 are −t_1, the same all the way; in units of |t_1| they serve as the
normalising factor, of which no single element vanishes with the baseline's direction.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from visctrl.geometry.robust.sampling import Samples, distinct_samples, ransac
from visctrl.geometry.trifocal.tensor import target_in_view

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Names of the elements in the order of the arrays.
ELEMENTS_2D = (
    *("T111", "T113", "T131", "T133"),
    *("T212", "T221", "T223", "T232"),
    *("T311", "T313", "T331", "T333"),
)
T212, T221, T223, T232 = (ELEMENTS_2D.index(name) for name in ("T212", "T221", "T223", "T232"))

_I, _J, _K = (np.array([int(name[at]) - 1 for name in ELEMENTS_2D]) for at in (1, 2, 3))
#: From (right, up, forward), the order of the indices, to rays (right, forward, up) and back.
_AXES = [0, 2, 1]
#: Minimal samples: three features are enough, four are much better determined.
SAMPLE_2D = 4
#: Eigenvalues less than this share of the largest count as 0: at the target, where the current
#: and the target view are one, the direction of t_1 is not determined.
_SINGULAR = 1e-12
#: Re-weightings of the linear solution.
_REWEIGHTINGS = 3


def turn_2d(heading: float) -> Array:
    """Return R (3, 3), the turn from the target's axes to those of a view with a heading (rad)."""
    s, c = np.sin(heading), np.cos(heading)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def tensor_2d(heading_1: float, target_1: Array, heading_2: float, target_2: Array) -> Array:
    """Return the tensor (12,) of two headings (rad) and targets (right, forward) (2,): (1.9)."""
    R1, R2 = turn_2d(heading_1), turn_2d(heading_2)
    t1, t2 = (np.array([t[0], 0.0, t[1]]) for t in (target_1, target_2))
    return np.asarray(R1[_J, _I] * t2[_K] - t1[_J] * R2[_K, _I])


def tensor_2d_from_poses(pose_1: ArrayLike, pose_2: ArrayLike) -> Array:
    """Return the metric tensor (12,) of two poses (3,), the target at the origin."""
    one, two = np.asarray(pose_1, dtype=np.float64), np.asarray(pose_2, dtype=np.float64)
    return tensor_2d(float(one[2]), target_in_view(one), float(two[2]), target_in_view(two))


def normalised_2d(tensor: Array, covariance: Array) -> tuple[Array, Array]:
    """Return a tensor (12,) in units of |t_1|, T232 negative, and its covariance (12, 12).

    T232 is −t_y1: the target lies ahead of the initial view.
    """
    size = np.hypot(tensor[T212], tensor[T232]) * (-1.0 if tensor[T232] > 0.0 else 1.0)
    T = tensor / size
    slope = np.zeros(12)
    slope[[T212, T232]] = T[[T212, T232]]
    J = (np.eye(12) - np.outer(T, slope)) / size
    return T, np.asarray(J @ covariance @ J.T)


def rates_2d(tensor: Array, heading_1: float, scale: float) -> Array:
    """Return J (12, 2) with T' = J (v, ω), of a tensor in units of ``scale`` metres."""
    R1, J = turn_2d(heading_1), np.zeros((12, 2))
    at = {name: element for element, name in enumerate(ELEMENTS_2D)}
    for name, element in at.items():
        # T232 and T212 belong to the initial and target views alone.
        if name.endswith("1"):
            J[element, 1] = tensor[at[name[:-1] + "3"]]
        elif name.endswith("3"):
            J[element, 1] = -tensor[at[name[:-1] + "1"]]
            J[element, 0] = -R1[_J[element], _I[element]] / scale
    return J


def heading_2d(tensor: Array, heading_1: float) -> float:
    """Return the current view's heading (rad) in a tensor (12,), that of view 1 being known."""
    # What is left of T without R1 t2 is −t1_j R2_ki, with R2 = [[c, s], [−s, c]].
    R1, t2 = turn_2d(heading_1), np.array([tensor[T221], 0.0, tensor[T223]])
    rest = tensor - R1[_J, _I] * t2[_K]
    weight = np.where(_J == 0, tensor[T212], tensor[T232]) * (_I != 1)
    cosine = float(np.sum((weight * rest)[_I == _K]))
    sine = float(np.sum((weight * rest)[(_I == 2) & (_K == 0)]))
    sine -= float(np.sum((weight * rest)[(_I == 0) & (_K == 2)]))
    return float(np.arctan2(sine, cosine))


class Incidence(NamedTuple):
    """The point relation [u]× (Σ w_i T_i) [v]× = 0 of N features, four equations each.

    error : (N, 4, 12), rows d with d·T the algebraic error.
    gradient : (N, 4, 6, 12), its derivatives by the two directions of each of the three rays.
    """

    error: Array
    gradient: Array

    def take(self, which: Mask) -> Incidence:
        """Return the relation of some of the features."""
        return Incidence(self.error[which], self.gradient[which])


def incidence(rays_1: Array, rays_2: Array, rays_3: Array) -> Incidence:
    """Return the relation of features by their unit rays (N, 3) in the three views."""
    u, v, w = (np.asarray(rays, dtype=np.float64)[:, _AXES] for rays in (rays_1, rays_2, rays_3))
    a, b, c = across(u), across(v), across(w)
    count = len(u)
    error = _forms(w[:, None, None], a[:, :, None], b[:, None]).reshape(count, 4, 12)
    gradient = np.zeros((count, 2, 2, 6, 12))
    for m in range(2):
        # Turning u towards a_m takes a_m to −u, and leaves the other direction alone.
        gradient[:, m, :, m] = _forms(w[:, None], -u[:, None], b)
        gradient[:, :, m, 2 + m] = _forms(w[:, None], a, -v[:, None])
        gradient[:, :, :, 4 + m] = _forms(c[:, m, None, None], a[:, :, None], b[:, None])
    return Incidence(error, gradient.reshape(count, 4, 6, 12))


def across(rays: Array) -> Array:
    """Return two unit vectors (N, 2, 3) at right angles to each ray and to each other."""
    axis = np.eye(3)[np.argmin(np.abs(rays), axis=1)]
    first = np.cross(rays, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(rays, first)], axis=1)


def solve_2d(relation: Incidence, sigma: float) -> tuple[Array, Array]:
    """Return the unit tensor (12,) of least weighted error, and its covariance (12, 12)."""
    weights = np.ones(relation.error.shape[:2])
    vectors = values = np.empty(0)
    for _ in range(_REWEIGHTINGS):
        A = (relation.error * weights[..., None]).reshape(-1, 12)
        values, vectors = np.linalg.eigh(A.T @ A)
        weights = 1.0 / np.maximum(_deviations(relation, vectors[:, 0], sigma), 1e-12)
    T = vectors[:, 0]
    span = vectors[:, 1:] / np.maximum(values[1:], _SINGULAR * values[-1])
    inverse = span @ vectors[:, 1:].T
    A = relation.error * weights[..., None]
    # The four errors of a feature share their rays: their covariance is that of its directions.
    by_direction = np.einsum("nqde,e,nq,nqf->ndf", relation.gradient, T, weights, A)
    noise = sigma**2 * np.einsum("nde,ndf->ef", by_direction, by_direction)
    return T, np.asarray(inverse @ noise @ inverse)


def residuals_2d(relation: Incidence, tensor: Array, sigma: float) -> Array:
    """Return each feature's root mean square error (N, ...), in standard deviations.

    Of one tensor (12,) or of several at once (12, H).
    """
    scaled = relation.error @ tensor / np.maximum(_deviations(relation, tensor, sigma), 1e-12)
    return np.asarray(np.sqrt(np.mean(scaled**2, axis=1)))


def ransac_2d(
    relation: Incidence, sigma: float, *, seed: int, threshold_sigmas: float, hypotheses: int
) -> Mask:
    """Return the features (N,) that agree with the best tensor of a random minimal sample."""

    def solve(samples: Samples) -> Array:
        A = relation.error[samples].reshape(len(samples), -1, 12)
        return np.asarray(np.linalg.eigh(np.swapaxes(A, 1, 2) @ A)[1][:, :, 0])

    return ransac(
        distinct_samples(len(relation.error), SAMPLE_2D, hypotheses, seed),
        solve,
        lambda tensors: residuals_2d(relation, tensors.T, sigma).T ** 2,
        threshold_sigmas**2,
    ).inliers


def _forms(w: Array, a: Array, b: Array) -> Array:
    """Return the products w_i a_j b_k (..., 12) of the elements' indices."""
    return np.asarray(w[..., _I] * a[..., _J] * b[..., _K])


def _deviations(relation: Incidence, tensor: Array, sigma: float) -> Array:
    """Return the standard deviations (N, 4, ...) of the algebraic errors."""
    return np.asarray(sigma * np.linalg.norm(relation.gradient @ tensor, axis=2))
