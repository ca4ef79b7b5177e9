"""OCamCalib's polynomial model (Scaramuzza, Martinelli, Siegwart 2006)."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from visctrl.hal.cameras.central import Array
from visctrl.hal.cameras.monotone import MonotoneInverse, increasing_up_to
from visctrl.hal.cameras.planar import AffineModel, axial, on_sphere, radial_jacobian


class OcamCamera(AffineModel):
    """The ray of a plane's point p is (p, a₀ + a₁ρ + a₂ρ² + ...), ρ = |p|, in pixels.

    The toolbox' file has the polynomial's sign reversed (its z axis points back), x and y
    exchanged, and one stretch of the affine part (row-major uu, uv, vu, vv) set to 1. Beyond the
    picture the polynomial means nothing: the model ends at the farthest corner.
    """

    model: Literal["ocam"] = "ocam"
    polynomial: Annotated[tuple[float, ...], Field(min_length=2)]
    affine: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 1.0)

    @model_validator(mode="after")
    def _usable(self) -> Self:
        if self.polynomial[0] <= 0.0:
            raise ValueError("polynomial: its first coefficient must be positive: a ray ahead")
        uu, uv, vu, vv = self.affine
        if uu * vv - uv * vu == 0.0:
            raise ValueError("affine: the matrix has no inverse")
        return self

    @cached_property
    def K(self) -> Array:
        """See `CentralCamera.K`."""
        uu, uv, vu, vv = self.affine
        return np.array([[uu, uv, self.cx], [vu, vv, self.cy], [0.0, 0.0, 1.0]])

    @property
    def coefficients(self) -> dict[str, float]:
        """a₀, a₁, ..."""
        return {f"a{k}": value for k, value in enumerate(self.polynomial)}

    def stretched(self, across: float, down: float) -> Self:
        """See `CentralCamera.stretched`."""
        uu, uv, vu, vv = self.affine
        data = {**self.model_dump(), "affine": (uu * across, uv * across, vu * down, vv * down)}
        return type(self).model_validate(data)

    @cached_property
    def limit(self) -> float:
        """The angle of the farthest corner, or where the polynomial stops opening."""
        return math.cos(self._radius_at.greatest)

    @cached_property
    def _radius_at(self) -> MonotoneInverse:
        """Radius (px) at an angle from the axis (rad)."""
        sides = np.array([[-0.5, self.width - 0.5], [-0.5, self.height - 0.5]])
        corners = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
        farthest = np.linalg.norm((corners - self.K[:2, 2]) @ self._inverse.T, axis=1).max()
        upper = increasing_up_to(self._angle, self._slope, float(farthest))
        return MonotoneInverse(self._angle, self._slope, upper)

    def _angle(self, radius: Array) -> Array:
        return np.arctan2(radius, np.polynomial.polynomial.polyval(radius, self.polynomial))

    def _slope(self, radius: Array) -> Array:
        """Return dθ/dρ (N,)."""
        f = np.polynomial.polynomial.polyval(radius, self.polynomial)
        slope = np.polynomial.polynomial.polyval(radius, self._derivative)
        return np.asarray((f - radius * slope) / (radius**2 + f**2))

    @cached_property
    def _derivative(self) -> Array:
        return np.asarray(np.polynomial.polynomial.polyder(self.polynomial), dtype=np.float64)

    def _to_plane(self, rays: Array) -> Array:
        sine, direction, z = axial(rays)
        return np.asarray(self._radius_at(np.arctan2(sine, z))[:, None] * direction)

    def _from_plane(self, points: Array) -> Array:
        radius = np.hypot(points[:, 0], points[:, 1])
        inside = radius <= self._radius_at.upper * (1.0 + 1e-12)
        return on_sphere(points, self._angle(np.where(inside, radius, np.nan)))

    def _plane_jacobian(self, rays: Array) -> Array:
        sine, _, z = axial(rays)
        radius = self._radius_at(np.arctan2(sine, z))
        slope = 1.0 / self._slope(radius)
        ratio = slope.copy()
        np.divide(radius, sine, out=ratio, where=sine > 0.0)
        return radial_jacobian(rays, ratio, slope)
