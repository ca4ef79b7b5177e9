"""On which side two rays of a feature meet, and at what angle."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def signed_parallax(rays_a: ArrayLike, rays_b: ArrayLike, phi: float, direction: float) -> Array:
    """Return the sine (N,) of the angle between the rays of each feature, the turn removed.

    Positive where the rays meet in front of both views, negative where they meet behind.
    """
    a, b = np.asarray(rays_a, dtype=np.float64), np.asarray(rays_b, dtype=np.float64)
    return meeting(_along_baseline(a, direction), _along_baseline(b, direction + phi))


def meeting(a: Array, b: Array) -> Array:
    """Return |a × b| (N,) of vectors (3, N), negative where the lines along them meet behind.

    The vectors' components are (along, across, up) the baseline; those that meet behind do so
    against their own sense, seen from b's centre a step along the baseline from a's.
    """
    across = a[2] * b[0] - a[0] * b[2]
    up = a[0] * b[1] - a[1] * b[0]
    along = a[1] * b[2] - a[2] * b[1]
    # λ_a a − λ_b b = baseline: the sum of both depths is this over |a × b|².
    depths = up * (a[1] + b[1]) - across * (a[2] + b[2])
    return np.asarray(np.copysign(np.sqrt(along**2 + across**2 + up**2), depths))


def _along_baseline(rays: Array, bearing: float) -> Array:
    """Return rays (N, 3) as components (3, N) along, across (to the right) and above a bearing."""
    s, c = np.sin(bearing), np.cos(bearing)
    right, forward, up = rays.T
    return np.stack([s * right + c * forward, c * right - s * forward, up])
