"""Pinhole with radial–tangential distortion: OpenCV's 4, 5 and 8 coefficients."""

from __future__ import annotations

from functools import cached_property
from typing import Literal

import numpy as np

from visctrl.hal.cameras.central import Array
from visctrl.hal.cameras.planar import PlanarModel, ratio_jacobian
from visctrl.hal.cameras.radtan import RadialTangential

_OPTICAL_AXIS = np.array([0.0, 0.0, 1.0])


class PinholeRadtanCamera(PlanarModel):
    """Perspective projection, then `RadialTangential` distortion, then K.

    It sees up to where the distortion folds back, at most 89° from the axis.
    """

    model: Literal["pinhole-radtan"] = "pinhole-radtan"
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    @property
    def rectilinear(self) -> bool:
        """Whether there is no distortion."""
        return self._distortion.none

    @cached_property
    def limit(self) -> float:
        """See `CentralCamera.limit`."""
        return float(1.0 / np.hypot(1.0, self._distortion.limit))

    @cached_property
    def _distortion(self) -> RadialTangential:
        return RadialTangential(**self.coefficients)

    def _to_plane(self, rays: Array) -> Array:
        return self._distortion.distort(rays[:, :2] / rays[:, 2:])

    def _from_plane(self, points: Array) -> Array:
        flat = self._distortion.undistort(points)
        rays = np.column_stack([flat, np.ones(len(flat))])
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def _plane_jacobian(self, rays: Array) -> Array:
        J = self._distortion.jacobian(rays[:, :2] / rays[:, 2:])
        slope = np.broadcast_to(_OPTICAL_AXIS, rays.shape)
        return np.asarray(J @ ratio_jacobian(rays, rays[:, 2], slope))
