"""Inverse of an increasing function: a table to start from, then Newton's method."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Function = Callable[[Array], Array]

_NODES = 1024
_STEPS = 12
#: A Newton step so short (of what is to be found) is the last: the next would be its square.
CONVERGED = 1e-9
#: Where the slope falls below this share of its value at 0, a model is not one to one any more:
#: a hundredth of a pixel's noise would be a pixel's.
LEAST_SLOPE = 0.01


class MonotoneInverse:
    """The inverse of a function with f(0) = 0 that increases on [0, upper].

    Parameters
    ----------
    function, slope : callables
        f and f', of arrays (N,).
    upper : float
        End of the interval.
    """

    def __init__(self, function: Function, slope: Function, upper: float) -> None:
        self._function, self._slope, self.upper = function, slope, upper
        # Denser towards 0, where most of a picture is if the interval is long.
        self._nodes = upper * np.linspace(0.0, 1.0, _NODES) ** 2
        self._values = function(self._nodes)
        self.greatest = float(self._values[-1])

    def __call__(self, values: Array) -> Array:
        """Return x (N,) with f(x) = ``values`` (N,), NaN where there is none in the interval."""
        inside = (values >= 0.0) & (values <= self.greatest * (1.0 + 1e-12))
        wanted = np.where(inside, values, 0.0)
        x = self.near(wanted)
        for _ in range(_STEPS):
            step = (self._function(x) - wanted) / self._slope(x)
            x = np.clip(x - step, 0.0, self.upper)
            if np.abs(step).max(initial=0.0) <= CONVERGED * self.upper:
                break
        return np.where(inside, x, np.nan)

    def near(self, values: Array) -> Array:
        """Return x (N,) with f(x) about ``values`` (N,), from the table, within the interval."""
        return np.interp(values, self._values, self._nodes)


def increasing_up_to(function: Function, slope: Function, upper: float) -> float:
    """Return up to where in [0, upper] a function rises by at least `LEAST_SLOPE` of f'(0).

    It is looked for on a grid and then by bisection.
    """
    grid = upper * np.linspace(0.0, 1.0, _NODES) ** 2
    least = LEAST_SLOPE * float(slope(grid[:1])[0])
    with np.errstate(all="ignore"):
        values, slopes = function(grid), slope(grid)
        rising = (slopes >= least) & np.isfinite(values)
        # A pole between two nodes: the function falls from one to the next.
        rising[1:] &= np.diff(values) > 0.0
        if rising.all():
            return upper
        last = int(np.argmin(rising)) - 1
        if last < 0:
            return 0.0
        low, high = float(grid[last]), float(grid[last + 1])
        for _ in range(60):
            middle = 0.5 * (low + high)
            at = np.array([middle])
            fine = slope(at)[0] >= least and float(function(at)[0]) >= float(values[last])
            low, high = (middle, high) if fine else (low, middle)
    return low
