"""Symmetric 2×2 matrices in plain floats: for what is done once a tick to two unknowns."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Pair = tuple[float, float]

#: Eigenvalues smaller than this share of the larger one count as zero.
RANK = 1e-14


class Symmetric2(NamedTuple):
    """The matrix [[a, b], [b, c]], positive semidefinite where an inverse is asked for."""

    a: float
    b: float
    c: float

    @classmethod
    def of(cls, matrix: Array) -> Symmetric2:
        """Return a matrix (2, 2) that is symmetric but for rounding."""
        (a, b), (d, c) = matrix.tolist()
        return cls(a, 0.5 * (b + d), c)

    @property
    def array(self) -> Array:
        """The matrix as an array (2, 2)."""
        return np.array([[self.a, self.b], [self.b, self.c]])

    @property
    def trace(self) -> float:
        """Sum of the eigenvalues."""
        return self.a + self.c

    def plus(self, other: Symmetric2, weight: float = 1.0) -> Symmetric2:
        """Return this matrix plus ``weight`` times another."""
        return Symmetric2(
            self.a + weight * other.a, self.b + weight * other.b, self.c + weight * other.c
        )

    def times(self, factor: float) -> Symmetric2:
        """Return the matrix times a number."""
        return Symmetric2(factor * self.a, factor * self.b, factor * self.c)

    def apply(self, vector: Pair) -> Pair:
        """Return the matrix times a vector."""
        x, y = vector
        return self.a * x + self.b * y, self.b * x + self.c * y

    @property
    def eigenvalues(self) -> Pair:
        """The smaller and the larger eigenvalue."""
        large = 0.5 * self.trace + math.hypot(0.5 * (self.a - self.c), self.b)
        # The product of both is the determinant: nothing cancels but what cancels there.
        return ((self.a * self.c - self.b * self.b) / large if large > 0.0 else 0.0), large

    def inverse(self) -> Symmetric2:
        """Return the inverse of a matrix that has one."""
        determinant = self.a * self.c - self.b * self.b
        return Symmetric2(self.c / determinant, -self.b / determinant, self.a / determinant)

    def pseudo_inverse(self) -> Symmetric2:
        """Return the Moore–Penrose inverse."""
        small, large = self.eigenvalues
        if small > RANK * large:
            return self.inverse()
        return self.times(1.0 / large**2) if large > 0.0 else self
