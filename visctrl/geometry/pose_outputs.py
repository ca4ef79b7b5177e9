"""What images tell of a planar pose, as functions of it with exact derivatives.

Poses are (x, y, φ) of the camera in the target's frame. Everything broadcasts over leading axes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from visctrl.geometry.trifocal.tensor import (
    T121,
    current_view_basis,
    normalised,
    target_in_view,
    view_parameters,
)

Array = NDArray[np.float64]


def epipole_bearings(pose: ArrayLike, reference: ArrayLike) -> tuple[Array, Array]:
    """Return the epipoles' bearings (..., 2) and ∂/∂(x, y, φ) of the pose (..., 2, 3).

    The first is the epipole in the view at ``reference`` (..., 3), the second in the one at
    ``pose`` (..., 3); both are directions of lines, modulo π. They are the arc tangents of (4.1),
    with which an epipole at infinity is harmless, and their derivatives those of (4.5) over
    1 + (e/αx)².
    """
    pose = np.asarray(pose, dtype=np.float64)
    reference = np.asarray(reference, dtype=np.float64)
    dx, dy = pose[..., 0] - reference[..., 0], pose[..., 1] - reference[..., 1]
    line = np.arctan2(dx, dy)
    square = np.maximum(dx * dx + dy * dy, 1e-12)
    value = np.stack([line + reference[..., 2], line + pose[..., 2]], axis=-1)
    slope = np.zeros((*value.shape, 3))
    slope[..., 0], slope[..., 1] = (dy / square)[..., None], (-dx / square)[..., None]
    slope[..., 1, 2] = 1.0
    return value, slope


def metric_elements(pose: ArrayLike, initial: ArrayLike) -> tuple[Array, Array]:
    """Return the metric tensor (..., 8) of (3.2) and ∂/∂(x2, y2, φ2) (..., 8, 3).

    Parameters
    ----------
    pose : (..., 3) array
        C2.
    initial : (..., 3) array
        C1.
    """
    pose = np.asarray(pose, dtype=np.float64)
    target = target_in_view(pose)
    view = view_parameters(pose[..., 2], target)
    c, s = view[..., 0], view[..., 1]
    by_pose = np.zeros((*view.shape, 3))
    by_pose[..., 0, 2], by_pose[..., 1, 2] = -s, c
    by_pose[..., 2, 0], by_pose[..., 2, 1], by_pose[..., 2, 2] = -c, -s, target[..., 1]
    by_pose[..., 3, 0], by_pose[..., 3, 1], by_pose[..., 3, 2] = s, -c, -target[..., 0]
    first = np.asarray(initial, dtype=np.float64)
    basis = current_view_basis(view_parameters(first[..., 2], target_in_view(first)))
    return np.asarray((basis @ view[..., None])[..., 0]), np.asarray(basis @ by_pose)


def normalised_elements(pose: ArrayLike, initial: ArrayLike) -> tuple[Array, Array]:
    """Return the elements over T121 (..., 8) and ∂/∂(x2, y2, φ2) (..., 8, 3).

    T121 moves with the pose, too: ∂(T/T121) = (∂T − (T/T121) ∂T121) / T121. Arguments as in
    `metric_elements`.
    """
    T, J = metric_elements(pose, initial)
    ratio = normalised(T)
    slope = (J - ratio[..., None] * J[..., None, T121, :]) / T[..., T121, None, None]
    return ratio, np.asarray(slope, dtype=np.float64)
