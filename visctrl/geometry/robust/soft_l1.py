"""Soft-L1 least squares of several small problems at once.

An array operation on a hundred features costs its call, not its arithmetic, and four times as much
where the arrays are not contiguous. So the features of P problems, N of each, lie side by side in
rows of P N, one row a quantity, and what is two by two or three by three is done in plain floats,
each problem on its own.

A residual x, in units of k standard deviations, costs √(1 + x²) − 1. Its weight in the normal
equations is w = 1/√(1 + x²), its curvature w³. Beyond a limit the cost stays what it is there.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.robust.least_squares import Options, Problem, Solved

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Normal = list[list[float]]
Delta = tuple[float, ...]

#: The residuals' unit in their standard deviations, k: the scale of the soft-L1 kernel.
KERNEL_SIGMAS = 1.5
#: A step shorter than this many standard deviations of what it corrects is the last one.
_LAST_STEP = 0.15
#: Least curvature of the kernel, relative to its weight, that a step counts on.
_LEAST_CURVATURE = 0.5
#: The noise is looked at while fewer than this part of the features are within the limit: by a low
#: quantile of the residuals, few outliers reaching it, which is this for a unit normal.
_MOST = 0.9
_QUANTILE, _NORMAL_QUANTILE = 0.3, 0.385
#: Variance, in that of the noise, from which residuals are those of a start that is far off; and
#: how often that may be found: outliers in great number look like it for ever.
_FAR_OFF, _FAR_POINTS = 4.0, 3


class Linear(Protocol):
    """Residuals, in units of ``KERNEL_SIGMAS`` deviations, and derivatives by K parameters."""

    @property
    def residual(self) -> Array:
        """(P N,)."""

    @property
    def jacobian(self) -> Array:
        """(K, P N)."""


LinearT = TypeVar("LinearT", bound=Linear)
PointT = TypeVar("PointT", bound=Delta)


class Settled(NamedTuple, Generic[LinearT]):
    """Residuals of all problems, and how much they count.

    weights : (P N,), of the features; zero where they do not count.
    inside : (P N,) features that count, None for all.
    """

    linear: LinearT
    weights: Array
    inside: Mask | None


class SoftL1Problem(Problem[PointT, Settled[LinearT], Normal, Delta], Generic[PointT, LinearT]):
    """P problems of N features each, whose points are tuples of K parameters.

    Parameters
    ----------
    limit : float
        Residuals beyond it do not count; where most show more noise than expected, so much more.
    usable : (P N,) array or None
        Features that count at all; None for all.
    """

    def __init__(self, limit: float = math.inf, usable: Mask | None = None) -> None:
        self._limit, self._usable = limit, usable
        self._number = 0

    @abstractmethod
    def residuals(self, points: list[PointT]) -> LinearT:
        """Return residuals and derivatives at P points."""

    @abstractmethod
    def solve(self, normal: Normal, damping: float) -> tuple[Delta, float]:
        """Return the step δ of one problem, and −gᵀ δ (see `Problem.steps`).

        Parameters
        ----------
        normal : the K rows of the Hessian, and the gradient g.
        damping : what is added to the Hessian's diagonal, relative to it.
        """

    def linearise(self, points: list[PointT]) -> tuple[Settled[LinearT], list[float], list[Normal]]:
        """Return residuals and weights, costs, and Hessians with the gradients below."""
        linear = self.residuals(points)
        weights, inside, costs, normals = _normal_equations(
            linear,
            len(points),
            self._limit,
            self._usable,
            may_be_far=self._number < _FAR_POINTS,
        )
        self._number += 1
        return Settled(linear, weights, inside), costs, normals

    def steps(self, normals: list[Normal], damping: list[float]) -> list[Solved[Delta]]:
        """Solve each problem on its own; a step is as long as its largest change."""
        steps = []
        for normal, damped in zip(normals, damping, strict=True):
            step, gain = self.solve(normal, damped)
            steps.append(Solved(step, gain, max(max(step), -min(step))))
        return steps


def options(iterations: int, longest: float) -> Options:
    """Return the loop's options: steps are damped once one was bad, and short ones are the last."""
    return Options(
        iterations,
        converged=(_LAST_STEP / KERNEL_SIGMAS) ** 2,
        longest=longest,
    )


def _normal_equations(
    linear: Linear,
    problems: int,
    limit: float,
    usable: Mask | None,
    *,
    may_be_far: bool,
) -> tuple[Array, Mask | None, list[float], list[Normal]]:
    """Return weights (P N,), who counts, costs, and Hessians with the gradients below."""
    residual, jacobian = linear.residual, linear.jacobian
    square, inside, units = residual * residual, usable, None
    if limit < math.inf:
        inside = _within(square, limit * limit, usable)
        if may_be_far and inside is not None:
            units = _units(square, problems, inside, usable)
            if units is not None:
                square = square / units
                inside = _within(square, limit * limit, usable)
    root = np.sqrt(square + 1.0)
    weights = 1.0 / root
    if inside is not None:
        weights *= inside
        root = np.where(inside, root, 1.0 if limit == math.inf else math.hypot(1.0, limit))
    if usable is not None:
        root = np.where(usable, root, 1.0)
    features = len(root) // problems
    costs = [total - features for total in root.reshape(problems, -1).sum(axis=1).tolist()]
    # The kernel's own curvature makes it a Newton step; far off that would overshoot.
    least: float | Array = _LEAST_CURVATURE
    if units is not None:
        # The same residuals cost less by a smaller unit, so that a descent goes on.
        costs = [c * u for c, u in zip(costs, units[::features].tolist(), strict=True)]
        least = np.where(units > 1.0, 1.0, _LEAST_CURVATURE)
    curvature = weights * np.maximum(weights * weights, least)
    rows = np.empty((len(jacobian) + 1, len(root)))
    for row, derivative in zip(rows, jacobian, strict=False):
        np.multiply(derivative, curvature, out=row)
    np.multiply(residual, weights, out=rows[-1])
    return weights, inside, costs, products(rows, jacobian, problems)


def _within(square: Array, limit2: float, usable: Mask | None) -> Mask | None:
    """Return which of x² (P N,) are under a limit, None for all."""
    inside = square < limit2
    if usable is not None:
        inside &= usable
    return some(inside)


def _units(square: Array, problems: int, inside: Mask, usable: Mask | None) -> Array | None:
    """Return the variance (P N,) for which to take the noise, None for its own.

    A start that is off by far more than the noise would keep to the few features that agree with
    it: there the noise is taken for as large as the residuals x² (P N,) let it look.
    """
    features = len(square) // problems
    counts = np.full(problems, features)
    if usable is not None:
        counts = usable.reshape(problems, features).sum(axis=1)
    few = inside.reshape(problems, features).sum(axis=1) < _MOST * counts
    if not few.any():
        return None
    shown = square if usable is None else np.where(usable, square, math.inf)
    ordered = np.sort(shown.reshape(problems, features), axis=1)
    low = ordered[np.arange(problems), (_QUANTILE * counts).astype(np.intp)]
    units = low * (KERNEL_SIGMAS / _NORMAL_QUANTILE) ** 2
    far = few & (units > _FAR_OFF)
    return np.repeat(np.where(far, units, 1.0), features) if far.any() else None


def some(inside: Mask) -> Mask | None:
    """Return who is ``inside``, None for all."""
    return None if np.count_nonzero(inside) == inside.size else inside


def products(rows: Array, columns: Array, problems: int) -> list[list[list[float]]]:
    """Return each problem's sums over its features of rows (K, P N) times columns (L, P N)."""
    a = rows.reshape(len(rows), problems, -1).swapaxes(0, 1)
    b = columns.reshape(len(columns), problems, -1).transpose(1, 2, 0)
    found: list[list[list[float]]] = (a @ b).tolist()
    return found


def medians(values: Array, problems: int, inside: Mask | None) -> list[list[float]]:
    """Return each problem's (upper) medians (K, P) of values (K, P N), of features ``inside``."""
    found: list[list[float]]
    shown = values if inside is None else np.where(inside, values, math.inf)
    shown = shown.reshape(len(values), problems, -1)
    if inside is None:
        middle = shown.shape[-1] // 2
        found = np.partition(shown, middle, axis=-1)[..., middle].tolist()
        return found
    middles = inside.reshape(problems, -1).sum(axis=-1) // 2
    found = np.sort(shown, axis=-1)[:, np.arange(problems), middles].tolist()
    return found
