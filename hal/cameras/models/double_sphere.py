"""Double sphere model (Usenko, Demmel, Cremers 2018): Basalt's and Kalibr's ``ds``."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from visctrl.hal.cameras.central import Array
from visctrl.hal.cameras.planar import PlanarModel, ratio_jacobian


class DoubleSphereCamera(PlanarModel):
    """Two unit spheres, ξ apart, then a pinhole shifted by α/(1 − α), then K."""

    model: Literal["double-sphere"] = "double-sphere"
    xi: Annotated[float, Field(gt=-1, le=1)]
    alpha: Annotated[float, Field(ge=0, le=1)]

    @cached_property
    def limit(self) -> float:
        """Where the direction from the second centre has z = −w₁, w₁ as in the paper's (44).

        The paper's (45) is a plane that lies within; this is the root of the condition itself.
        """
        low, high = sorted((self.alpha, 1.0 - self.alpha))
        w = low / high
        root = math.sqrt(1.0 + self.xi**2 * (w**2 - 1.0))
        return -self.xi * (1.0 - w**2) - w * root

    def _to_plane(self, rays: Array) -> Array:
        return np.asarray(rays[:, :2] / self._depth(rays)[0][:, None])

    def _from_plane(self, points: Array) -> Array:
        square = (points**2).sum(axis=1)
        root = 1.0 - (2.0 * self.alpha - 1.0) * square
        root = np.sqrt(np.where(root >= 0.0, root, np.nan))
        mz = (1.0 - self.alpha**2 * square) / (self.alpha * root + 1.0 - self.alpha)
        under = mz**2 + (1.0 - self.xi**2) * square
        factor = (mz * self.xi + np.sqrt(np.where(under >= 0.0, under, np.nan))) / (mz**2 + square)
        return np.column_stack([factor[:, None] * points, factor * mz - self.xi])

    def _plane_jacobian(self, rays: Array) -> Array:
        depth, second = self._depth(rays)
        slope = self.alpha * rays / second[:, None]
        slope[:, 2] += self.alpha * self.xi / second + 1.0 - self.alpha
        return ratio_jacobian(rays, depth, slope)

    def _depth(self, rays: Array) -> tuple[Array, Array]:
        """Return what x and y are divided by (N,), and the distance from the second centre."""
        z = rays[:, 2] + self.xi
        second = np.sqrt(rays[:, 0] ** 2 + rays[:, 1] ** 2 + z * z)
        return self.alpha * second + (1.0 - self.alpha) * z, second
