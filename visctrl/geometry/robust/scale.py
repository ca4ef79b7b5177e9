"""Robust scale of residuals: the median absolute deviation (MAD)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Standard deviation of a normal variable over its median absolute deviation, 1/Φ⁻¹(3/4).
MAD_TO_SD = 1.4826


def mad_sd(residuals: Array) -> float:
    """Return the standard deviation of residuals (N,) about 0 as their MAD tells it.

    It stays bounded while fewer than half of them are gross errors.
    """
    return MAD_TO_SD * float(np.median(np.abs(residuals)))


def upper_mad_sd(residuals: Array) -> float:
    """Return `mad_sd` by the upper median of an even number, in a tenth of the time.

    For the tick's hundred residuals the two differ by less than the noise; for a dozen they do not.
    """
    size, middle = np.abs(residuals), len(residuals) // 2
    size.partition(middle)
    return MAD_TO_SD * float(size[middle])
