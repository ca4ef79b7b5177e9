"""Features of several pairs of views of a level camera, turned about their baselines."""

from __future__ import annotations

import cmath
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


class LevelPairs:
    """N features in P pairs of views (A, B), with the pairs side by side in rows of P N.

    The level part of a ray is a complex number, right + i forward: to turn it by an angle is to
    multiply it by exp(i angle), and with the bearing of a baseline that makes it the part across
    plus i times the part along.

    Parameters
    ----------
    a : (P, 3, N) array
        Rays (right, forward, up) of any length.
    b : (P, 3, N) array, or (3, N) where all pairs share the view
    """

    def __init__(self, a: Array, b: Array) -> None:
        self.pairs, _, self.features = a.shape
        self._level = np.empty((2, self.pairs, self.features), dtype=np.complex128)
        self._up = np.empty((2, self.pairs, self.features))
        self._level[0].real, self._level[0].imag, self._up[0] = a[:, 0], a[:, 1], a[:, 2]
        #: Up components (P N,).
        self.a_up, self.b_up = self._up.reshape(2, -1)
        self.look(b)

    def look(self, b: Array) -> None:
        """Put other rays in the place of view B's."""
        self._level[1].real, self._level[1].imag = b[..., 0, :], b[..., 1, :]
        self._up[1] = b[..., 2, :]
        self._heights = self.a_up + self.b_up

    def turned(self, motions: Sequence[tuple[float, ...]]) -> tuple[Complex, Complex]:
        """Return the level parts (P N,) of both views about each pair's baseline.

        motions : P tuples that begin with φ and θ (rad): the baseline lies at the bearing θ in
        view A and at θ + φ in view B.
        """
        turns = [cmath.rect(1.0, motion[1]) for motion in motions]
        turns += [cmath.rect(1.0, motion[0] + motion[1]) for motion in motions]
        a, b = (self._level * np.array(turns).reshape(2, -1, 1)).reshape(2, -1)
        return a, b

    def front(self, a: Complex, b: Complex) -> Array:
        """Return who is in front of the views (P N,), > 0, and who behind, by level parts.

        It is the sine of a feature's parallax times the sum of both rays' sines from the
        baseline, for rays of unit length. In components along, across and above the baseline,
        λ_a a − λ_b b = baseline has the sum of depths (a × b) · (b + a) / |a × b|², the first
        components left out.
        """
        level = a.imag * b.real - a.real * b.imag
        upright = self.b_up * a.imag - self.a_up * b.imag
        return np.asarray(level * (a.real + b.real) + upright * self._heights)
