"""The trilinear relation of three views with a known initial view, of many robots at once.

Feature by feature u, v, w are the bearings (sin θ, cos θ) in the initial, current and target
view (see `visctrl.geometry.trifocal`), × is the cross product of two of them and · the dot
product. With the initial view known, i.e. φ1 and t_1, and R_n what turns the target's axes into
those of view n, the relation Σ T_ijk u_i v_j w_k = 0 of (3.1) and (3.2) falls into products

    a P + b Q = 0,    a = t_1 × u,  b = u × R_1 w,  P = v × R_2 w,  Q = v × t_2.

It says that the feature's distance from the target is the same in views 1 and 2. Turning a
bearing by a right angle makes dot products of cross products, so with g = t_1 · u up to sign,
d = u · R_1 w, D = v · R_2 w, E = v · t_2 every derivative is a product of these eight. That is
a twentieth of the work of the 8 × 4 linear forms that the single fit uses for any tensor.

R robots, N features; every array is (R, N) unless said.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from visctrl.montecarlo.robots import Array, Index, Robots


class Bearings(NamedTuple):
    """Bearings of unit rays as (sin θ, cos θ), and by how much a direction's error grows there."""

    sine: Array
    cosine: Array
    slant: Array

    @classmethod
    def of(cls, rays: Array) -> Bearings:
        """Read unit rays (R, N, 3)."""
        right, forward = rays[..., 0], rays[..., 1]
        slant = 1.0 / np.sqrt(np.maximum(right * right + forward * forward, 1e-18))
        return cls(right * slant, forward * slant, slant)


class Products(NamedTuple):
    """P, Q, D and E of one view: what the relation needs of it."""

    P: Array
    Q: Array
    D: Array
    E: Array


class Slopes(NamedTuple):
    """Derivatives of the Sampson residual by the algebraic error and its three derivatives."""

    error: Array
    initial: Array
    target: Array
    current: Array


class FixedViews(Robots):
    """The initial and target views of R drives.

    Parameters
    ----------
    initial, target : (R, N, 3) arrays
        Unit rays.
    """

    def __init__(self, initial: Array, target: Array) -> None:
        u, w = Bearings.of(initial), Bearings.of(target)
        self.initial, self.target = u, w
        self._cross = u.sine * w.cosine - u.cosine * w.sine
        self._dot = u.sine * w.sine + u.cosine * w.cosine

    def relation(self, view: Array, current: Array) -> Relation:
        """Return the relation for initial views (R, 2) and current rays (R, N, 3).

        view : heading φ1 and bearing of the target (rad); the target's distance is the unit.
        """
        u, v, w = self.initial, Bearings.of(current), self.target
        (phi, bearing) = view.T[:, :, None]
        s, c = np.sin(phi), np.cos(phi)
        right, forward = np.sin(bearing), np.cos(bearing)
        return Relation(
            a=right * u.cosine - forward * u.sine,
            g=-(right * u.sine + forward * u.cosine),
            b=c * self._cross - s * self._dot,
            d=c * self._dot + s * self._cross,
            S=v.sine * w.cosine - v.cosine * w.sine,
            C=v.sine * w.sine + v.cosine * w.cosine,
            sine=v.sine,
            cosine=v.cosine,
            slant_1=u.slant,
            slant_2=v.slant,
            slant_3=w.slant,
        )


class Relation(NamedTuple):
    """The relation of R robots. z (R, 4) is (cos φ2, sin φ2, t_x2, t_y2) up to a factor.

    a, g, b, d : of the initial view. S, C : v × w and v · w. sine, cosine : v. slant_n : of the
    bearings in view n.
    """

    a: Array
    g: Array
    b: Array
    d: Array
    S: Array
    C: Array
    sine: Array
    cosine: Array
    slant_1: Array
    slant_2: Array
    slant_3: Array

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
        aD = self.a * D
        error = self.a * P + self.b * Q
        by_1 = self.slant_1 * (self.g * P + self.d * Q)
        by_2 = self.slant_2 * (aD + self.b * E)
        by_3 = -self.slant_3 * (self.d * Q + aD)
        square = by_1 * by_1 + by_2 * by_2 + by_3 * by_3
        inverse = 1.0 / np.sqrt(np.maximum(square, 1e-24))
        residual = error * inverse
        fall = -residual * inverse * inverse
        return residual, Slopes(inverse, by_1 * fall, by_3 * fall, by_2 * fall)

    def jacobian(self, slopes: Slopes, out: Array) -> None:
        """Write the derivatives (R, 4, N) of the residuals by z to ``out``."""
        error, by_1 = slopes.error, self.slant_1 * slopes.initial
        by_2, by_3 = self.slant_2 * slopes.current, self.slant_3 * slopes.target
        along, across = self.a * error + self.g * by_1, self.a * (by_2 - by_3)
        out[:, 0] = self.S * along + self.C * across
        out[:, 1] = self.S * across - self.C * along
        along, across = self.b * error + self.d * (by_1 - by_3), self.b * by_2
        out[:, 2] = self.sine * across - self.cosine * along
        out[:, 3] = self.sine * along + self.cosine * across

    def by_initial(self, view: Products, slopes: Slopes, out: Array) -> None:
        """Write the derivatives (R, 2, N) of the residuals by (φ1, bearing) to ``out``."""
        P, Q, D, E = view
        error, by_1 = slopes.error, self.slant_1 * slopes.initial
        by_2, by_3 = self.slant_2 * slopes.current, self.slant_3 * slopes.target
        out[:, 0] = Q * (self.b * (by_1 - by_3) - self.d * error) - self.d * E * by_2
        out[:, 1] = P * (self.a * by_1 - self.g * error) + self.g * D * (by_3 - by_2)
