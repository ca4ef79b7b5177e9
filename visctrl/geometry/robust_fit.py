"""Soft-L1 least squares of several small problems at once.

An array operation on a hundred features costs its call, not its arithmetic. So the residuals of
all problems are evaluated together, (P, N) at a time, and what is two by two or three by three is
done in plain floats, each problem on its own.

A residual of r standard deviations, with x = r/k, costs √(1 + x²) − 1. Its weight in the normal
equations is w = 1/√(1 + x²), its curvature w³. Beyond a limit the cost stays what it is there.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Normal = list[list[float]]

#: Scale of the soft-L1 kernel, k, in standard deviations of the residual.
_KERNEL_SIGMAS = 1.5
#: A step shorter than this many standard deviations of what it corrects is the last one.
_LAST_STEP = 0.1
#: Least curvature of the kernel, relative to its weight, that a step counts on.
_LEAST_CURVATURE = 0.5
#: The limit is widened while fewer than this part of the features are within it, ...
_MOST = 0.5
#: ... in proportion to a low quantile of the residuals, few outliers reaching it; and that
#: quantile for a unit normal.
_QUANTILE, _NORMAL_QUANTILE = 0.3, 0.385


class Linear(Protocol):
    """Residuals (P, N) and their derivatives (P, k, N) by k parameters."""

    @property
    def residual(self) -> Array:
        """(P, N)."""

    @property
    def jacobian(self) -> Array:
        """(P, k, N)."""


LinearT = TypeVar("LinearT", bound=Linear)
PointT = TypeVar("PointT")


class Descent(ABC, Generic[PointT]):
    """Levenberg–Marquardt of one problem in plain floats, fed with what a batch evaluates.

    ahead : the point to evaluate next; once ``done``, the end.
    refused : whether the point that was evaluated last was worse than one before.
    """

    def __init__(self, start: PointT, iterations: int) -> None:
        self.ahead = start
        self.done = self.refused = False
        self._best = start
        self._cost = math.inf
        self._normal: Normal = []
        self._damping = 0.0
        self._left = iterations

    @abstractmethod
    def step(self, point: PointT, normal: Normal, damping: float) -> tuple[PointT, float]:
        """Return the point after a step, and −gᵀ δ for its full length.

        Parameters
        ----------
        point : where the step begins.
        normal : the k rows of the Hessian, and the gradient g.
        damping : what is added to the Hessian's diagonal, relative to it.
        """

    def take(self, cost: float, normal: Normal, sigma: float) -> None:
        """Take in the cost at the point ahead and its normal equations, and go on from the best."""
        if self.done:
            return
        self.refused = cost > self._cost
        if self.refused:
            self._damping = 10.0 * max(self._damping, 1e-5)
        else:
            self._best, self._cost, self._normal = self.ahead, cost, normal
            self._damping *= 0.1
        self.ahead, gain = self.step(self._best, self._normal, self._damping)
        self._left -= 1
        # −gᵀ δ is δᵀ H δ: the step's length in variances of what it corrects.
        self.done = gain < (_LAST_STEP * sigma) ** 2 or self._left <= 0


class Settled(NamedTuple, Generic[LinearT]):
    """Where the descents have ended, but for last steps that are too short to matter.

    weights : (P, N), of the features; zero where they do not count.
    inside : (P, N) features that count, None for all.
    """

    linear: LinearT
    weights: Array
    inside: Mask | None


def settle(
    linearise: Callable[[list[PointT]], LinearT],
    descents: Sequence[Descent[PointT]],
    sigma: float,
    *,
    limit: float = math.inf,
    usable: Mask | None = None,
) -> Settled[LinearT]:
    """Let descents run to their ends, which are then in their ``ahead``.

    Parameters
    ----------
    linearise : function
        From P points to their residuals and derivatives.
    descents : P descents
    sigma : float
        Standard deviation of a residual.
    limit : float
        Residuals beyond it do not count; it is wider while most residuals are.
    usable : (P, N) array or None
        Features that count at all; None for all.
    """
    while True:
        linear = linearise([descent.ahead for descent in descents])
        weights, inside, costs, normals = _normal_equations(linear, sigma, limit, usable)
        if all(descent.done for descent in descents):
            break
        for descent, cost, normal in zip(descents, costs, normals, strict=True):
            descent.take(cost, normal, sigma)
        if all(descent.done and not descent.refused for descent in descents):
            break
    return Settled(linear, weights, inside)


def _normal_equations(
    linear: Linear, sigma: float, limit: float, usable: Mask | None
) -> tuple[Array, Mask | None, list[float], list[Normal]]:
    """Return weights (P, N), who counts, costs, and Hessians with the gradients below."""
    scaled = linear.residual * (1.0 / (_KERNEL_SIGMAS * sigma))
    root = np.sqrt(scaled * scaled + 1.0)
    weights = 1.0 / root
    inside = usable
    if limit < math.inf:
        root, inside = _limited(root, limit / (_KERNEL_SIGMAS * sigma), usable)
    if inside is not None:
        weights *= inside
    if usable is not None:
        root = np.where(usable, root, 1.0)
    count = root.shape[1]
    costs = [cost - count for cost in root.sum(axis=1).tolist()]
    # The kernel's own curvature makes it a Newton step; far off that would overshoot.
    least = np.array([[_LEAST_CURVATURE if cost < count else 1.0] for cost in costs])
    curvature = weights * np.maximum(weights * weights, least)
    jacobian = linear.jacobian
    rows = np.empty((len(root), jacobian.shape[1] + 1, count))
    np.multiply(jacobian, curvature[:, None], out=rows[:, :-1])
    np.multiply(linear.residual, weights, out=rows[:, -1])
    return weights, inside, costs, (rows @ jacobian.transpose(0, 2, 1)).tolist()


def _limited(root: Array, limit: float, usable: Mask | None) -> tuple[Array, Mask | None]:
    """Return √(1 + x²) (P, N) no more than at a limit of x, and who is within it.

    A start that is off by more than the limit would keep to the few features that agree with it:
    there the limit grows with the residuals that are usual.
    """
    cap = math.sqrt(1.0 + limit * limit)
    inside = root < cap
    if usable is not None:
        inside &= usable
    within = np.count_nonzero(inside)
    if within == inside.size:
        return root, None
    if within > (1.0 - (1.0 - _MOST) / len(root)) * inside.size:
        return np.minimum(root, cap), inside
    shown = root if usable is None else np.where(usable, root, math.inf)
    counts = np.full(len(root), root.shape[1]) if usable is None else usable.sum(axis=1)
    low = np.sort(shown, axis=1)[np.arange(len(root)), (_QUANTILE * counts).astype(np.intp)]
    usual = np.sqrt(low * low - 1.0) * (_KERNEL_SIGMAS / _NORMAL_QUANTILE)
    few = inside.sum(axis=1) < _MOST * counts
    caps = np.sqrt(1.0 + (limit * np.where(few, np.maximum(usual, 1.0), 1.0)) ** 2)[:, None]
    inside = root < caps
    if usable is not None:
        inside &= usable
    return np.minimum(root, caps), inside


def medians(values: Array, inside: Mask | None) -> list[list[float]]:
    """Return the (upper) medians (K, P) of values (K, P, N), of features ``inside`` (P, N)."""
    found: list[list[float]]
    if inside is None:
        middle = values.shape[-1] // 2
        found = np.partition(values, middle, axis=-1)[..., middle].tolist()
        return found
    ordered = np.sort(np.where(inside, values, math.inf), axis=-1)
    middles = inside.sum(axis=-1) // 2
    found = ordered[:, np.arange(len(middles)), middles].tolist()
    return found
