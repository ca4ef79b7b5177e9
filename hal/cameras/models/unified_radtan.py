"""Unified sphere model with radial–tangential distortion (Mei and Rives 2007).

Kalibr's ``omni`` with ``radtan``, OpenCV's ``omnidir``, CamOdoCal's ``MEI``.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from visctrl.hal.cameras.central import Array
from visctrl.hal.cameras.planar import PlanarModel, ratio_jacobian
from visctrl.hal.cameras.radtan import RadialTangential

_OPTICAL_AXIS = np.array([0.0, 0.0, 1.0])


class UnifiedRadtanCamera(PlanarModel):
    """The unified sphere model, then `RadialTangential` distortion, then K."""

    model: Literal["unified-radtan"] = "unified-radtan"
    xi: Annotated[float, Field(ge=0)]
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @cached_property
    def limit(self) -> float:
        """The sphere model's own limit, or where the distortion folds back."""
        xi, square = self.xi, self._distortion.limit**2
        if xi > 1.0 and square * (xi**2 - 1.0) >= 1.0:
            return -1.0 / xi
        return (xi + math.sqrt(1.0 + (1.0 - xi**2) * square)) / (1.0 + square) - xi

    @cached_property
    def _distortion(self) -> RadialTangential:
        return RadialTangential(self.k1, self.k2, self.p1, self.p2)

    def _to_plane(self, rays: Array) -> Array:
        return self._distortion.distort(rays[:, :2] / (rays[:, 2:] + self.xi))

    def _from_plane(self, points: Array) -> Array:
        flat = self._distortion.undistort(points)
        square = (flat**2).sum(axis=1)
        root = 1.0 + (1.0 - self.xi**2) * square
        factor = (self.xi + np.sqrt(np.where(root >= 0.0, root, np.nan))) / (1.0 + square)
        return np.column_stack([factor[:, None] * flat, factor - self.xi])

    def _plane_jacobian(self, rays: Array) -> Array:
        J = self._distortion.jacobian(rays[:, :2] / (rays[:, 2:] + self.xi))
        slope = np.broadcast_to(_OPTICAL_AXIS, rays.shape)
        return np.asarray(J @ ratio_jacobian(rays, rays[:, 2] + self.xi, slope))
