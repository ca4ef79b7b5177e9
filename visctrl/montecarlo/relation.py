"""The trilinear relation of three views with a known initial view, of many robots at once.

Feature by feature u, v, w are the bearings (sin θ, cos θ) in the initial, current and target
view (see `visctrl.geometry.trifocal.tensor`), × is the cross product of two of them and · the dot
product. With the initial view known, i.e. φ1 and t_1, and R_n what turns the target's axes into
those of view n, the relation Σ T_ijk u_i v_j w_k = 0 of (3.1) and (3.2) falls into products

    a P + b Q = 0,    a = t_1 × u,  b = u × R_1 w,  P = v × R_2 w,  Q = v × t_2.

It says that the feature's distance from the target is the same in views 1 and 2. Turning a
bearing by a right angle makes dot products of cross products, so with g = −t_1 · u,
d = u · R_1 w, D = v · R_2 w, E = v · t_2 every derivative is a product of these eight. That is
a fraction of the work of the 8 × 4 linear forms that the single fit uses for any tensor.

R robots, N features; every array is (R, N) unless said.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from visctrl.montecarlo.robots import Array, Index, Parts, Robots


class Products(NamedTuple):
    """P, Q, D and E of one view: what the relation needs of it."""

    P: Array
    Q: Array
    D: Array
    E: Array


class Slopes(NamedTuple):
    """Derivatives of the Sampson residuals by the algebraic error and by its gradient's parts.

    The parts are those by the bearings in views 1, 2 and 3, without the factors that say by how
    much a direction's error grows when it is read as a bearing; these are in the slopes twice.
    """

    error: Array
    by_1: Array
    by_2: Array
    by_3: Array


class FixedViews(Robots):
    """The initial and target views of R drives.

    Parameters
    ----------
    initial, target : Parts
        Unit rays.
    """

    def __init__(self, initial: Parts, target: Parts) -> None:
        (u, growth_1), (w, growth_3) = _bearings(initial), _bearings(target)
        self._initial, self._target = u, w
        self._growth_1, self._growth_3 = growth_1, growth_3
        self._cross = u[0] * w[1] - u[1] * w[0]
        self._dot = u[0] * w[0] + u[1] * w[1]

    def relation(self, view: Array, current: Parts) -> Relation:
        """Return the relation for initial views (R, 2) and current rays.

        view : heading φ1 and bearing of the target (rad); the target's distance is the unit.
        """
        (sine, cosine), growth_2 = _bearings(current)
        u, w = self._initial, self._target
        phi, bearing = view.T[:, :, None]
        s, c = np.sin(phi), np.cos(phi)
        right, forward = np.sin(bearing), np.cos(bearing)
        return Relation(
            a=right * u[1] - forward * u[0],
            g=-right * u[0] - forward * u[1],
            b=c * self._cross - s * self._dot,
            d=c * self._dot + s * self._cross,
            S=sine * w[1] - cosine * w[0],
            C=sine * w[0] + cosine * w[1],
            sine=sine,
            cosine=cosine,
            growth_1=self._growth_1,
            growth_2=growth_2,
            growth_3=self._growth_3,
        )


class Relation(NamedTuple):
    """The relation of R robots. z (R, 4) is (cos φ2, sin φ2, t_x2, t_y2) up to a factor.

    a, g, b, d : of the initial view. S, C : v × w and v · w. sine, cosine : v. growth_n : by how
    much the variance of a direction grows when it is read as a bearing of view n.
    """

    a: Array
    g: Array
    b: Array
    d: Array
    S: Array
    C: Array
    sine: Array
    cosine: Array
    growth_1: Array
    growth_2: Array
    growth_3: Array

    def take(self, index: Index) -> Relation:
        """Return the relation of some of the robots."""
        return Relation(*(each[index] for each in self))

    def products(self, z: Array) -> Products:
        """Return the products for view coordinates z."""
        c, s, x, y = z.T[:, :, None]
        return Products(
            c * self.S - s * self.C,
            self.sine * y - self.cosine * x,
            c * self.C + s * self.S,
            self.sine * x + self.cosine * y,
        )

    def linearised(self, view: Products) -> tuple[Array, Slopes]:
        """Return the Sampson residuals (rad) and their slopes."""
        P, Q, D, E = view
        aD, dQ = self.a * D, self.d * Q
        by_1, by_2, by_3 = self.g * P + dQ, aD + self.b * E, -aD - dQ
        grown_1, grown_2 = self.growth_1 * by_1, self.growth_2 * by_2
        grown_3 = self.growth_3 * by_3
        square = grown_1 * by_1
        square += grown_2 * by_2
        square += grown_3 * by_3
        inverse = 1.0 / np.sqrt(np.maximum(square, 1e-24))
        residual = (self.a * P + self.b * Q) * inverse
        fall = -residual * inverse
        fall *= inverse
        grown_1 *= fall
        grown_2 *= fall
        grown_3 *= fall
        return residual, Slopes(inverse, grown_1, grown_2, grown_3)

    def jacobian(self, slopes: Slopes, out: Array) -> None:
        """Write the derivatives (R, 4, N) of the residuals by z to ``out``."""
        error, by_1, by_2, by_3 = slopes
        along, across = self.a * error + self.g * by_1, self.a * (by_2 - by_3)
        np.multiply(self.S, along, out=out[:, 0])
        out[:, 0] += self.C * across
        np.multiply(self.S, across, out=out[:, 1])
        out[:, 1] -= self.C * along
        along, across = self.b * error + self.d * (by_1 - by_3), self.b * by_2
        np.multiply(self.sine, across, out=out[:, 2])
        out[:, 2] -= self.cosine * along
        np.multiply(self.sine, along, out=out[:, 3])
        out[:, 3] += self.cosine * across

    def by_initial(self, view: Products, slopes: Slopes, out: Array) -> None:
        """Write the derivatives (R, 2, N) of the residuals by (φ1, bearing) to ``out``."""
        P, Q, D, E = view
        error, by_1, by_2, by_3 = slopes
        np.multiply(Q, self.b * (by_1 - by_3) - self.d * error, out=out[:, 0])
        out[:, 0] -= self.d * E * by_2
        np.multiply(P, self.a * by_1 - self.g * error, out=out[:, 1])
        out[:, 1] += self.g * D * (by_3 - by_2)


def _bearings(rays: Parts) -> tuple[tuple[Array, Array], Array]:
    """Return bearings as (sin θ, cos θ), and the growth of a direction's variance in them."""
    right, forward, _ = rays
    growth = 1.0 / np.maximum(right * right + forward * forward, 1e-18)
    slant = np.sqrt(growth)
    return (right * slant, forward * slant), growth
