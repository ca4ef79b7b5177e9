"""Small symmetric matrices in plain floats: for what is done once a tick to a few unknowns."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Pair = tuple[float, float]

#: Eigenvalues smaller than this share of the larger one count as zero.
RANK = 1e-14
#: Share of its bound that the determinant of a 4×4 matrix must have for cofactors to be exact.
_SOUND = 1e-4


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


def inverse4(matrix: Array) -> Array:
    """Return the inverse (4, 4) of a positive definite matrix.

    In half the time that LAPACK takes, by cofactors. They lose digits where the matrix is nearly
    singular, which is left to LAPACK.
    """
    (a, b, c, d), (_, e, f, g), (_, _, h, i), (_, _, _, j) = matrix.tolist()
    # Minors of the upper two rows and of the lower two, named by their columns.
    u01, u02, u03 = a * e - b * b, a * f - b * c, a * g - b * d
    u12, u13, u23 = b * f - e * c, b * g - e * d, c * g - f * d
    l01, l02, l03 = u23, c * i - h * d, c * j - i * d
    l12, l13, l23 = f * i - h * g, f * j - i * g, h * j - i * i
    determinant = u01 * l23 - u02 * l13 + u03 * l12 + u12 * l03 - u13 * l02 + u23 * l01
    # At most the product of the diagonal (Hadamard); a small share of it has cancelled.
    if not determinant > _SOUND * a * e * h * j:
        return np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    by = 1.0 / determinant
    aa, ee = by * (e * l23 - f * l13 + g * l12), by * (a * l23 - c * l03 + d * l02)
    hh, jj = by * (d * u13 - g * u03 + j * u01), by * (c * u12 - f * u02 + h * u01)
    ab, ac = by * (c * l13 - b * l23 - d * l12), by * (g * u23 - i * u13 + j * u12)
    ad, ef = by * (h * u13 - f * u23 - i * u12), by * (i * u03 - d * u23 - j * u02)
    eg, hi = by * (c * u23 - h * u03 + i * u02), by * (f * u03 - c * u13 - i * u01)
    return np.array([[aa, ab, ac, ad], [ab, ee, ef, eg], [ac, ef, hh, hi], [ad, eg, hi, jj]])
