"""Minimal solver: the planar motion of a calibrated camera from the rays of two features."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def two_point_motions(a: Array, b: Array) -> Array:
    """Return the bearings (θ, α), (2H, 2), of the motions through samples (H, 2, 3).

    With m = (cos θ, sin θ), n = (cos α, sin α) the constraints read P m + Q n = 0, so that
    m = W n with W = −P⁻¹Q; |m| = |n| = 1 is an equation in cos 2α, sin 2α.
    """
    P = b[..., 2:3] * a[..., :2] * [1.0, -1.0]
    Q = a[..., 2:3] * b[..., :2] * [-1.0, 1.0]
    det = P[:, 0, 0] * P[:, 1, 1] - P[:, 0, 1] * P[:, 1, 0]
    det = np.where(np.abs(det) > 1e-300, det, 1e-300)
    adjugate = np.stack([P[:, 1, 1], -P[:, 0, 1], -P[:, 1, 0], P[:, 0, 0]], axis=-1).reshape(
        -1, 2, 2
    )
    W = -(adjugate @ Q) / det[:, None, None]
    S = np.swapaxes(W, 1, 2) @ W
    mean, half, cross = (S[:, 0, 0] + S[:, 1, 1]) / 2, (S[:, 0, 0] - S[:, 1, 1]) / 2, S[:, 0, 1]
    amplitude = np.maximum(np.hypot(half, cross), 1e-300)
    # Outside [−1, 1] no motion fits exactly; the nearest one is kept (vanishing baseline).
    opening = np.arccos(np.clip((1.0 - mean) / amplitude, -1.0, 1.0))
    centre = np.arctan2(cross, half)
    alpha = np.concatenate([centre + opening, centre - opening]) / 2.0
    W = np.concatenate([W, W])
    c, s = np.cos(alpha), np.sin(alpha)
    theta = np.arctan2(W[:, 1, 0] * c + W[:, 1, 1] * s, W[:, 0, 0] * c + W[:, 0, 1] * s)
    return np.stack([theta, alpha], axis=-1)
