"""Unified sphere model (1.6), (1.7): perspective, catadioptric and fisheye cameras.

A ray goes to the unit sphere, from there to the normalised plane seen from a centre ξ above the
sphere's centre, then to pixels by K. ξ = 0 is a perspective camera, 0 < ξ < 1 hyper-catadioptric,
ξ = 1 para-catadioptric, ξ > 1 a fisheye lens (Geyer and Daniilidis 2000, Barreto 2001).
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from visctrl.hal.cameras.central import Array, CentralCamera, Focal, Mask, normalised

_ONES = np.ones(3)
_OPTICAL_AXIS = np.array([[0.0], [0.0], [1.0]])


class UnifiedCamera(CentralCamera):
    """The unified sphere model without lens distortion.

    All that is linear in a ray and its length is done at once (see `_forms`): these calls are
    on the tick. A negative ``fx`` is the left–right reversal of a real mirror.
    """

    model: Literal["unified"] = "unified"
    xi: Annotated[float, Field(ge=0)]
    fx: Focal
    fy: Focal
    skew: float = 0.0

    @property
    def rectilinear(self) -> bool:
        """Whether ξ = 0."""
        return self.xi == 0.0

    @property
    def limit(self) -> float:
        """−1/ξ for ξ > 1, beyond which the sphere's far side projects onto the same pixels.

        For ξ ≤ 1 it is the plane z = −ξ through the upper centre.
        """
        return -1.0 / self.xi if self.xi > 1.0 else -self.xi

    @property
    def K(self) -> Array:
        """See `CentralCamera.K`."""
        return np.array([[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def coefficients(self) -> dict[str, float]:
        """ξ."""
        return {"xi": self.xi}

    def stretched(self, across: float, down: float) -> Self:
        """See `CentralCamera.stretched`."""
        return self.altered(fx=self.fx * across, skew=self.skew * across, fy=self.fy * down)

    def project(self, rays: ArrayLike) -> tuple[Array, Mask]:
        """See `CentralCamera.project`."""
        return self._image(rays, self._forms)

    def unproject(self, pixels: ArrayLike) -> tuple[Array, Mask]:
        """See `CentralCamera.unproject`."""
        return self._rays(pixels, self._inverse, _OPTICAL_AXIS)

    def robot_rays(self, pixels: ArrayLike) -> tuple[Array, Mask]:
        """See `CentralCamera.robot_rays`."""
        return self._rays(pixels, self._robot_inverse, self.rotation[:, 2:])

    def robot_pixels(self, rays: ArrayLike) -> tuple[Array, Mask]:
        """See `CentralCamera.robot_pixels`."""
        return self._image(rays, self._robot_forms)

    def jacobian(self, rays: ArrayLike) -> Array:
        """See `CentralCamera.jacobian`."""
        unit = normalised(rays)
        sx, sy, sz = unit[..., 0], unit[..., 1], unit[..., 2]
        depth = sz + self.xi
        # d(x, y)/d(ray) before normalisation to the sphere is removed by the tangent projector.
        plane = np.zeros((*unit.shape[:-1], 2, 3))
        plane[..., 0, 0] = plane[..., 1, 1] = 1.0 / depth
        plane[..., 0, 2] = -sx / depth**2
        plane[..., 1, 2] = -sy / depth**2
        tangent = np.eye(3) - unit[..., :, None] * unit[..., None, :]
        return np.asarray(self.K[:2, :2] @ plane @ tangent, dtype=np.float64)

    def bearing_per_pixel(self, rays: ArrayLike) -> Array:
        """See `CentralCamera.bearing_per_pixel`."""
        rays = np.asarray(rays, dtype=np.float64)
        if self._upright is not None:
            # About an upright axis the bearing is the angle about the image's centre.
            depth = rays[..., 2] * self._upright + self.xi
            level = np.hypot(rays[..., 0], rays[..., 1])
            with np.errstate(divide="ignore", invalid="ignore"):
                return np.asarray(np.abs(depth / (self.fx * level)), dtype=np.float64)
        ray = rays @ self.rotation
        up = self.rotation[2].tolist()
        x, y, z = ray[..., 0], ray[..., 1], ray[..., 2]
        # The ray turns by one radian of bearing along ray × up; up, less its part along the ray,
        # leaves the bearing alone. A pixel's noise in any direction counts by its part across
        # the latter's image.
        sideways = (y * up[2] - z * up[1], z * up[0] - x * up[2], x * up[1] - y * up[0])
        height = x * up[0] + y * up[1] + z * up[2]
        upwards = (up[0] - height * x, up[1] - height * y, up[2] - height * z)
        depth = z + self.xi
        a, b = ((dx * depth - x * dz, dy * depth - y * dz) for dx, dy, dz in (sideways, upwards))
        across = np.abs((self.fx * self.fy) * (a[0] * b[1] - a[1] * b[0]))
        length = np.hypot(self.fx * b[0] + self.skew * b[1], self.fy * b[1])
        turn = np.full(across.shape, np.inf)
        np.divide(length * depth * depth, across, out=turn, where=across > 0.0)
        return turn

    @cached_property
    def _upright(self) -> float | None:
        """Which way the optical axis points if it is exactly vertical and pixels are square.

        1 is up, −1 down, None is any other camera.
        """
        square = abs(self.fx) == abs(self.fy) and self.skew == 0.0
        if self.panoramic and square and self.pitch_deg == 0.0 and self.roll_deg == 0.0:
            return float(self.rotation[2, 2])
        return None

    def _image(self, rays: ArrayLike, forms: Array) -> tuple[Array, Mask]:
        """Return what `project` returns, by the forms (see `_forms`) of the rays' axes."""
        rays = np.asarray(rays, dtype=np.float64)
        ray = np.empty((4, math.prod(rays.shape[:-1])))
        ray[:3] = rays.reshape(-1, 3).T
        np.sqrt(_ONES.dot(ray[:3] * ray[:3]), out=ray[3])
        found = forms.dot(ray)
        inside = found[3:] > 0.0
        valid = np.logical_and.reduce(inside)
        depth = found[2]
        if not valid.all():
            depth = np.where(inside[-1] & inside[-2], depth, np.nan)
        pixels = found[:2] / depth
        return pixels.T.reshape(*rays.shape[:-1], 2), valid.reshape(rays.shape[:-1])

    def _rays(self, pixels: ArrayLike, inverse: Array, axis: Array) -> tuple[Array, Mask]:
        """Return what `unproject` returns, in any axes.

        inverse : `_inverse` in these axes; axis : (3, 1), the optical axis.
        """
        pixels = np.asarray(pixels, dtype=np.float64)
        image = np.empty((3, math.prod(pixels.shape[:-1])))
        image[:2], image[2] = pixels.reshape(-1, 2).T, 1.0
        found = inverse.dot(image)
        ray = found[:3]
        square, xi = _ONES.dot(ray * ray), self.xi
        root = (1.0 - xi**2) * square + xi**2
        if xi > 1.0:
            root = np.where(root >= 0.0, root, np.nan)
        factor = (np.sqrt(root) + xi) / square
        ray *= factor
        ray -= xi * axis
        low, high = self.field
        valid = np.logical_and.reduce(found[3:] >= 0.0) & (factor >= low + xi)
        if high < 1.0:
            valid &= factor <= high + xi
        return ray.T.reshape(*pixels.shape[:-1], 3), valid.reshape(pixels.shape[:-1])

    @cached_property
    def _forms(self) -> Array:
        """(9, 4): what is linear in a ray and its length, (x, y, z, ρ).

        The image (u, v, 1) times the depth z + ξρ, how far inside the image's four edges that
        is, and how far inside the bounds of the field of view: a ray is seen where all of the
        last six are positive.
        """
        image = np.array(
            [
                [self.fx, self.skew, self.cx, self.cx * self.xi],
                [0.0, self.fy, self.cy, self.cy * self.xi],
                [0.0, 0.0, 1.0, self.xi],
            ]
        )
        low, high = self.field
        field = np.array([[0.0, 0.0, -1.0, high], [0.0, 0.0, 1.0, -low]])
        return np.concatenate([image, self._edges.dot(image), field])

    @cached_property
    def _robot_forms(self) -> Array:
        """(9, 4): `_forms` of robot rays."""
        return np.concatenate([self._forms[:, :3].dot(self.rotation.T), self._forms[:, 3:]], axis=1)

    @cached_property
    def _inverse(self) -> Array:
        """(7, 3): takes (u, v, 1) to (x, y, 1) on the normalised plane, and to `_edges`."""
        return np.concatenate([np.linalg.inv(self.K), self._edges])

    @cached_property
    def _robot_inverse(self) -> Array:
        """(7, 3): `_inverse` with the plane's points in robot axes."""
        return np.concatenate([self.rotation.dot(self._inverse[:3]), self._edges])

    @cached_property
    def _edges(self) -> Array:
        """(4, 3): takes (u, v, 1) to its distances from the outer edges of the image (px)."""
        right, bottom = self.width - 0.5, self.height - 0.5
        return np.array([[1.0, 0.0, 0.5], [-1.0, 0.0, right], [0.0, 1.0, 0.5], [0.0, -1.0, bottom]])
