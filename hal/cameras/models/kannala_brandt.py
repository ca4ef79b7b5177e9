"""Kannala–Brandt fisheye (2006): OpenCV's ``fisheye``, Kalibr's and ROS' ``equidistant``."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Literal

import numpy as np

from visctrl.hal.cameras.central import Array
from visctrl.hal.cameras.monotone import MonotoneInverse, increasing_up_to
from visctrl.hal.cameras.planar import PlanarModel, axial, on_sphere, radial_jacobian


class KannalaBrandtCamera(PlanarModel):
    """Radius r = θ + k1 θ³ + k2 θ⁵ + k3 θ⁷ + k4 θ⁹ at θ (rad) from the axis, then K."""

    model: Literal["kannala-brandt"] = "kannala-brandt"
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    @cached_property
    def limit(self) -> float:
        """Where the polynomial stops rising."""
        return math.cos(self._inverse_radius.upper)

    @cached_property
    def _inverse_radius(self) -> MonotoneInverse:
        upper = increasing_up_to(self._radius, self._slope, math.pi)
        return MonotoneInverse(self._radius, self._slope, upper)

    def _radius(self, theta: Array) -> Array:
        t = theta * theta
        series = self.k1 + t * (self.k2 + t * (self.k3 + t * self.k4))
        return np.asarray(theta * (1.0 + t * series))

    def _slope(self, theta: Array) -> Array:
        t = theta * theta
        series = 3.0 * self.k1 + t * (5.0 * self.k2 + t * (7.0 * self.k3 + t * 9.0 * self.k4))
        return np.asarray(1.0 + t * series)

    def _to_plane(self, rays: Array) -> Array:
        sine, direction, z = axial(rays)
        return np.asarray(self._radius(np.arctan2(sine, z))[:, None] * direction)

    def _from_plane(self, points: Array) -> Array:
        return on_sphere(points, self._inverse_radius(np.hypot(points[:, 0], points[:, 1])))

    def _plane_jacobian(self, rays: Array) -> Array:
        sine, _, z = axial(rays)
        theta = np.arctan2(sine, z)
        ratio = np.ones_like(sine)
        np.divide(self._radius(theta), sine, out=ratio, where=sine > 0.0)
        return radial_jacobian(rays, ratio, self._slope(theta))
