"""Extended unified camera model (Khomutenko, Garcia, Martinet 2016): ``eucm``."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from visctrl.hal.cameras.central import Array
from visctrl.hal.cameras.planar import PlanarModel, ratio_jacobian


class ExtendedUnifiedCamera(PlanarModel):
    """Points (x, y)/(α d + (1 − α) z) with d² = β (x² + y²) + z², then K.

    β = 1 is the unified model with ξ = α/(1 − α).
    """

    model: Literal["extended-unified"] = "extended-unified"
    alpha: Annotated[float, Field(ge=0, le=1)]
    beta: Annotated[float, Field(gt=0)]

    @cached_property
    def limit(self) -> float:
        """Where z = −w d, w the lesser of α/(1 − α) and its inverse."""
        low, high = sorted((self.alpha, 1.0 - self.alpha))
        w = (low / high) ** 2
        return -math.sqrt(w * self.beta / (1.0 - w + w * self.beta))

    def _to_plane(self, rays: Array) -> Array:
        return np.asarray(rays[:, :2] / self._depth(rays)[0][:, None])

    def _from_plane(self, points: Array) -> Array:
        square = self.beta * (points**2).sum(axis=1)
        root = 1.0 - (2.0 * self.alpha - 1.0) * square
        root = np.sqrt(np.where(root >= 0.0, root, np.nan))
        mz = (1.0 - self.alpha**2 * square) / (self.alpha * root + 1.0 - self.alpha)
        rays = np.column_stack([points, mz])
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def _plane_jacobian(self, rays: Array) -> Array:
        depth, d = self._depth(rays)
        slope = self.alpha * rays * [self.beta, self.beta, 1.0] / d[:, None]
        slope[:, 2] += 1.0 - self.alpha
        return ratio_jacobian(rays, depth, slope)

    def _depth(self, rays: Array) -> tuple[Array, Array]:
        """Return what x and y are divided by (N,), and d (N,)."""
        d = np.sqrt(self.beta * (rays[:, 0] ** 2 + rays[:, 1] ** 2) + rays[:, 2] ** 2)
        return self.alpha * d + (1.0 - self.alpha) * rays[:, 2], d
