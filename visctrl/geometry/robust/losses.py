"""Weights of robust losses: what a residual counts in iteratively re-weighted least squares.

A loss ρ(x) of residuals x in units of its scale has the weight ρ′(x)/x. Huber's and the soft-L1
loss are convex; Cauchy's redescends, so that gross errors end up with little weight, but a fit can
end in another minimum than the best.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def cauchy(square: Array) -> Array:
    """Return the weights 1/(1 + x²) of squared residuals: ρ = ln(1 + x²)/2."""
    return 1.0 / (1.0 + square)


def huber(size: Array, threshold: float) -> Array:
    """Return the weights min(1, k/|x|) of absolute residuals: beyond k a constant pull."""
    return np.asarray(np.minimum(1.0, threshold / np.maximum(size, 1e-12)))
