"""Models by way of a plane: ray to a point of the normalised plane, that to pixels by K.

What is common to them is here: the affine part, the picture's edges, the field of view.
"""

from __future__ import annotations

from abc import abstractmethod
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from visctrl.hal.cameras.central import Array, CentralCamera, Focal, Mask, normalised


class AffineModel(CentralCamera):
    """A camera whose pixels are an affine map, ``K``, of a point that depends on the ray alone."""

    @abstractmethod
    def _to_plane(self, rays: Array) -> Array:
        """Return the points (N, 2) of the normalised plane of unit rays (N, 3) within `limit`."""

    @abstractmethod
    def _from_plane(self, points: Array) -> Array:
        """Return the unit rays (N, 3) of points (N, 2), NaN where the model has none."""

    @abstractmethod
    def _plane_jacobian(self, rays: Array) -> Array:
        """Return ∂point/∂ray (N, 2, 3) of any extension of `_to_plane` off the unit sphere."""

    def project(self, rays: ArrayLike) -> tuple[Array, Mask]:
        """See `CentralCamera.project`."""
        rays = np.asarray(rays, dtype=np.float64)
        with np.errstate(invalid="ignore", divide="ignore"):
            unit = normalised(rays.reshape(-1, 3))
            low, high = self.field
            seen = (unit[:, 2] > low) & (unit[:, 2] < high)
        pixels = np.full((len(unit), 2), np.nan)
        pixels[seen] = self._to_plane(unit[seen]) @ self.K[:2, :2].T + self.K[:2, 2]
        valid = seen & self.contains(pixels)
        return pixels.reshape(*rays.shape[:-1], 2), valid.reshape(rays.shape[:-1])

    def unproject(self, pixels: ArrayLike) -> tuple[Array, Mask]:
        """See `CentralCamera.unproject`."""
        pixels = np.asarray(pixels, dtype=np.float64)
        flat = pixels.reshape(-1, 2)
        rays = self._from_plane((flat - self.K[:2, 2]) @ self._inverse.T)
        low, high = self.field
        valid = self.contains(flat) & (rays[:, 2] >= low) & (rays[:, 2] <= high)
        return rays.reshape(*pixels.shape[:-1], 3), valid.reshape(pixels.shape[:-1])

    def jacobian(self, rays: ArrayLike) -> Array:
        """See `CentralCamera.jacobian`."""
        rays = np.asarray(rays, dtype=np.float64)
        unit = normalised(rays.reshape(-1, 3))
        tangent = np.eye(3) - unit[:, :, None] * unit[:, None, :]
        J = self.K[:2, :2] @ self._plane_jacobian(unit) @ tangent
        return np.asarray(J.reshape(*rays.shape[:-1], 2, 3))

    @cached_property
    def _inverse(self) -> Array:
        """(2, 2): from pixels, less the principal point, to the normalised plane."""
        return np.asarray(np.linalg.inv(self.K[:2, :2]))


class PlanarModel(AffineModel):
    """A camera with the usual K = [fx skew cx; 0 fy cy; 0 0 1]."""

    fx: Focal
    fy: Focal
    skew: float = 0.0

    @cached_property
    def K(self) -> Array:
        """See `CentralCamera.K`."""
        return np.array([[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def coefficients(self) -> dict[str, float]:
        """The fields that the model adds, in their order."""
        common = PlanarModel.model_fields
        return {key: getattr(self, key) for key in type(self).model_fields if key not in common}

    def stretched(self, across: float, down: float) -> Self:
        """See `CentralCamera.stretched`."""
        return self.altered(fx=self.fx * across, skew=self.skew * across, fy=self.fy * down)


def ratio_jacobian(rays: Array, depth: Array, slope: Array) -> Array:
    """Return ∂(x/d, y/d)/∂ray (N, 2, 3) of rays (N, 3), given d (N,) and ∂d/∂ray (N, 3)."""
    J = -rays[:, :2, None] * (slope / depth[:, None] ** 2)[:, None, :]
    J[:, 0, 0] += 1.0 / depth
    J[:, 1, 1] += 1.0 / depth
    return np.asarray(J)


def axial(rays: Array) -> tuple[Array, Array, Array]:
    """Return distance from the axis (N,), its direction (N, 2), and z (N,) of rays (N, 3).

    On the axis the direction is that of x.
    """
    radius = np.hypot(rays[:, 0], rays[:, 1])
    direction = np.zeros((len(rays), 2))
    direction[:, 0] = 1.0
    np.divide(rays[:, :2], radius[:, None], out=direction, where=radius[:, None] > 0.0)
    return radius, direction, rays[:, 2]


def radial_jacobian(rays: Array, ratio: Array, slope: Array) -> Array:
    """Return ∂point/∂ray (N, 2, 3) of a radially symmetric model.

    Parameters
    ----------
    rays : (N, 3) array
        Unit rays.
    ratio : (N,) array
        Radius in the plane over distance from the axis, r(θ)/sin θ.
    slope : (N,) array
        dr/dθ, θ the angle from the optical axis.
    """
    radius, e, z = axial(rays)
    across = np.stack([-e[:, 1], e[:, 0]], axis=-1)
    J = np.zeros((len(rays), 2, 3))
    # θ grows along (z e, −sin θ), the azimuth along the direction across.
    along = np.concatenate([z[:, None] * e, -radius[:, None]], axis=-1)
    J += slope[:, None, None] * e[:, :, None] * along[:, None, :]
    J[:, :, :2] += ratio[:, None, None] * across[:, :, None] * across[:, None, :]
    return J


def on_sphere(points: Array, polar: Array) -> Array:
    """Return unit rays (N, 3) at angles ``polar`` (N,) from the axis towards points (N, 2)."""
    radius = np.hypot(points[:, 0], points[:, 1])
    direction = np.zeros_like(points)
    np.divide(points, radius[:, None], out=direction, where=radius[:, None] > 0.0)
    return np.column_stack([np.sin(polar)[:, None] * direction, np.cos(polar)])
