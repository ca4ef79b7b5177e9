"""Radial–tangential distortion (Brown 1966, Conrady 1919) of the normalised plane.

With r² = x² + y² and c = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶),

    x' = c x + 2 p1 x y + p2 (r² + 2 x²)        y' = c y + p1 (r² + 2 y²) + 2 p2 x y

as OpenCV, Kalibr, ROS and CamOdoCal have it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.monotone import CONVERGED, MonotoneInverse, increasing_up_to

Array = NDArray[np.float64]

#: Radius up to which a distortion is looked at: the tangent of 89°.
WIDEST = 57.0
_AZIMUTHS = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
_STEPS = 15
#: So much farther out than the radial part reaches, the tangential one brings no point back.
_FAR = 1.2
#: Residual of an inverse that has been found, relative to the point's own size.
_SOLVED = 1e-12


@dataclass(frozen=True)
class RadialTangential:
    """Distortion by its coefficients; points are (N, 2) on the normalised plane."""

    k1: float
    k2: float
    p1: float
    p2: float
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    @property
    def none(self) -> bool:
        """Whether it leaves every point where it is."""
        return not any((self.k1, self.k2, self.p1, self.p2, self.k3, self.k4, self.k5, self.k6))

    def distort(self, points: Array) -> Array:
        """Return the images of points."""
        x, y = points.T
        square = x * x + y * y
        c, _ = self._factor(square)
        return np.column_stack(
            [
                c * x + 2.0 * self.p1 * x * y + self.p2 * (square + 2.0 * x * x),
                c * y + self.p1 * (square + 2.0 * y * y) + 2.0 * self.p2 * x * y,
            ]
        )

    def jacobian(self, points: Array) -> Array:
        """Return the derivatives (N, 2, 2) at points; they are symmetric."""
        x, y = points.T
        c, slope = self._factor(x * x + y * y)
        J = np.empty((len(points), 2, 2))
        J[:, 0, 0] = c + 2.0 * x * x * slope + 2.0 * self.p1 * y + 6.0 * self.p2 * x
        J[:, 1, 1] = c + 2.0 * y * y * slope + 6.0 * self.p1 * y + 2.0 * self.p2 * x
        J[:, 0, 1] = J[:, 1, 0] = 2.0 * (x * y * slope + self.p1 * x + self.p2 * y)
        return J

    def undistort(self, points: Array) -> Array:
        """Return the points that have these images, NaN where none has within `limit`.

        Newton's method from where the radial part alone puts them.
        """
        radius = np.hypot(points[:, 0], points[:, 1])
        start = self._radial_inverse.near(radius)
        found = points * (start / np.where(radius > 0.0, radius, 1.0))[:, None]
        found[radius > _FAR * self._radial_inverse.greatest] = np.nan
        with np.errstate(all="ignore"):
            for _ in range(_STEPS):
                J = self.jacobian(found)
                off = self.distort(found) - points
                # Far outside of the image circle the system may be singular: not a number there.
                scale = 1.0 / (J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] ** 2)
                step = np.column_stack(
                    [
                        (J[:, 1, 1] * off[:, 0] - J[:, 0, 1] * off[:, 1]) * scale,
                        (J[:, 0, 0] * off[:, 1] - J[:, 0, 1] * off[:, 0]) * scale,
                    ]
                )
                found = found - step
                if not (np.abs(step) > CONVERGED).any():
                    break
            off = np.abs(self.distort(found) - points).max(axis=1, initial=0.0)
            inside = np.hypot(found[:, 0], found[:, 1]) <= self.limit * (1.0 + 1e-12)
            good = inside & (off <= _SOLVED * (1.0 + radius))
        return np.where(good[:, None], found, np.nan)

    @cached_property
    def limit(self) -> float:
        """Radius of the disc on which the distortion is one to one.

        Its derivative is symmetric, so it is the gradient of a function; where the derivative is
        positive definite that function is convex, and no two points share an image.
        """
        return increasing_up_to(self._radial, self._least_slope, WIDEST)

    @cached_property
    def _radial_inverse(self) -> MonotoneInverse:
        return MonotoneInverse(self._radial, self._radial_slope, self.limit)

    def _radial(self, radius: Array) -> Array:
        return radius * self._factor(radius * radius)[0]

    def _radial_slope(self, radius: Array) -> Array:
        c, slope = self._factor(radius * radius)
        return c + 2.0 * radius * radius * slope

    def _least_slope(self, radius: Array) -> Array:
        """Return the smallest eigenvalue (N,) of the derivative on circles of a radius (N,)."""
        circle = np.stack([np.cos(_AZIMUTHS), np.sin(_AZIMUTHS)], axis=-1)
        J = self.jacobian((radius[:, None, None] * circle).reshape(-1, 2))
        mean, half = 0.5 * (J[:, 0, 0] + J[:, 1, 1]), 0.5 * (J[:, 0, 0] - J[:, 1, 1])
        least = mean - np.hypot(half, J[:, 0, 1])
        return np.asarray(least.reshape(len(radius), -1).min(axis=1))

    def _factor(self, square: Array) -> tuple[Array, Array]:
        """Return c and dc/d(r²) of r² (N,)."""
        above = 1.0 + square * (self.k1 + square * (self.k2 + square * self.k3))
        below = 1.0 + square * (self.k4 + square * (self.k5 + square * self.k6))
        up = self.k1 + square * (2.0 * self.k2 + 3.0 * square * self.k3)
        down = self.k4 + square * (2.0 * self.k5 + 3.0 * square * self.k6)
        return above / below, (up - above / below * down) / below
