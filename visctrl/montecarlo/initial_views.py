"""The initial views of many drives: `visctrl.schemes.trifocal.initial_view` in arrays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from visctrl.geometry.robust.symmetric import RANK
from visctrl.montecarlo.fit import Couplings
from visctrl.montecarlo.robots import Array, Mask, Robots
from visctrl.schemes.trifocal.initial_view import AGREEMENT, ALIKE, AT_MOST, CONDITION


class Matrices(NamedTuple):
    """R symmetric matrices [[a, b], [b, c]]: see `visctrl.geometry.robust.symmetric.Symmetric2`."""

    a: Array
    b: Array
    c: Array

    @classmethod
    def of(cls, matrices: Array) -> Matrices:
        """Return matrices (R, 2, 2) that are symmetric but for rounding."""
        off = 0.5 * (matrices[:, 0, 1] + matrices[:, 1, 0])
        return cls(matrices[:, 0, 0], off, matrices[:, 1, 1])

    @property
    def trace(self) -> Array:
        """Sums of the eigenvalues."""
        return self.a + self.c

    @property
    def determinant(self) -> Array:
        """Products of the eigenvalues."""
        return self.a * self.c - self.b * self.b

    def plus(self, other: Matrices, weight: Array | float = 1.0) -> Matrices:
        """Return these matrices plus ``weight`` times others."""
        a, b, c = other
        return Matrices(self.a + weight * a, self.b + weight * b, self.c + weight * c)

    def times(self, factor: Array) -> Matrices:
        """Return the matrices times a number each."""
        return Matrices(self.a * factor, self.b * factor, self.c * factor)

    def apply(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the matrices times vectors (x, y)."""
        return self.a * x + self.b * y, self.b * x + self.c * y

    def eigenvalues(self) -> tuple[Array, Array]:
        """Return the smaller and the larger eigenvalues of matrices that are not 0."""
        large = 0.5 * self.trace + np.hypot(0.5 * (self.a - self.c), self.b)
        return self.determinant / large, large

    def inverse(self) -> Matrices:
        """Return the inverses."""
        inverse = 1.0 / self.determinant
        return Matrices(self.c * inverse, -self.b * inverse, self.a * inverse)


class InitialViews(Robots):
    """The initial views of R drives and their filters: see `InitialViewFilter`.

    Parameters
    ----------
    prior : (R, 2) array
        Heading of the initial view, and the bearing at which it sees the target (rad).
    covariance : (R, 2, 2) array
        Of the prior, finite.

    Attributes
    ----------
    state : (R, 2) array
        The best one so far.
    covariance : Matrices
        Of it.
    """

    def __init__(self, prior: Array, covariance: Array) -> None:
        self.prior, self.state, self.covariance = prior, prior.copy(), Matrices.of(covariance)
        self._prior_information = self.covariance.inverse()
        nothing = np.zeros(len(prior))
        self._information = Matrices(nothing, nothing, nothing)
        self._weighted = nothing, nothing
        self._best = nothing

    def update(self, known: Couplings) -> None:
        """Take in what one tick's fits, made with the present ``state``, say about it."""
        information = Matrices.of(known.information)
        weight = np.where(self._best > 0.0, 1.0 / ALIKE, 1.0)
        pull = information.apply(*(self.state - self.prior).T)
        total = self._information.plus(information, weight)
        self._best = np.maximum(self._best, information.trace)
        excess = total.trace / np.maximum(AT_MOST * self._best, 1e-300)
        share = 1.0 / np.maximum(excess, 1.0)
        self._information = total.times(share)
        x, y = self._weighted
        self._weighted = (
            share * (x + weight * (pull[0] + known.gradient[:, 0])),
            share * (y + weight * (pull[1] + known.gradient[:, 1])),
        )
        self._fuse()

    def _fuse(self) -> None:
        """Combine the prior with the bearings, at the weight that it has left."""
        prior, bearings = self._prior_information, self._information
        (x, y), total = self._weighted, prior.plus(bearings)
        small, large = total.eigenvalues()
        sound = (small * CONDITION >= large) & (large > 0.0)
        alone, together = _pseudo_inverse(bearings).apply(x, y), total.inverse().apply(x, y)
        distance2 = x * (alone[0] - together[0]) + y * (alone[1] - together[1])
        doubt = np.maximum(1.0, 1.0 + distance2 - AGREEMENT)
        covariance = bearings.plus(prior, 1.0 / doubt).inverse()
        state = self.prior + np.stack(covariance.apply(x, y), axis=1)
        self.covariance = _chosen(sound, covariance, self.covariance)
        self.state = np.where(sound[:, None], state, self.state)


def _pseudo_inverse(matrices: Matrices) -> Matrices:
    small, large = matrices.eigenvalues()
    flat = matrices.times(1.0 / large**2)
    return _chosen(small > RANK * large, matrices.inverse(), flat)


def _chosen(which: Mask, one: Matrices, other: Matrices) -> Matrices:
    a, b, c = other
    return Matrices(np.where(which, one.a, a), np.where(which, one.b, b), np.where(which, one.c, c))
