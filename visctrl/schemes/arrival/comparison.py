"""A view beside the target's: the same features in both, whatever they were found by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.schemes.arrival.displacement import Array, Sighting


@dataclass(frozen=True)
class Comparison:
    """N features of the target, and where they are now.

    ids : (N,) their names. target : (N, 3) unit rays. current : where they are seen now.
    coincides : (N,) whether a feature is where the target has it.
    contrast : (N,) how strong its pattern is.
    """

    ids: NDArray[np.int64]
    target: Array
    current: Sighting
    coincides: NDArray[np.bool_]
    contrast: Array

    @classmethod
    def nothing(cls) -> Comparison:
        """Return a comparison without features."""
        none = np.empty((0, 3))
        return cls(
            np.empty(0, dtype=np.int64),
            none,
            Sighting(none, np.empty((0, 2, 2))),
            np.empty(0, dtype=np.bool_),
            np.empty(0),
        )

    @property
    def share(self) -> float:
        """Share of the target's features that coincide."""
        return float(self.coincides.mean()) if len(self.ids) else 0.0

    @property
    def found(self) -> int:
        """Number of features that are seen at all."""
        return int(np.isfinite(self.current.rays).all(axis=-1).sum())


def whitening(camera: CentralCamera, points: Array, covariance: Array) -> Array:
    """Return what makes errors of (bearing · cos ε, elevation) unit noise, (N, 2, 2).

    points : (N, 2) in the image. covariance : (N, 2, 2) of the points (px²), or one for all.
    """
    step, about = 0.5, camera.robot_rays(points)[0]
    columns = []
    for shift in (np.array([step, 0.0]), np.array([0.0, step])):
        ahead, behind = (camera.robot_rays(points + each)[0] for each in (shift, -shift))
        columns.append((_angles(ahead, about) - _angles(behind, about)) / (2.0 * step))
    jacobian = np.stack(columns, axis=-1)
    # At the edge of the field of view a pixel may mean anything.
    usable = np.isfinite(jacobian).all(axis=(1, 2), keepdims=True)
    jacobian = np.where(usable, jacobian, np.eye(2))
    seen = jacobian @ covariance @ jacobian.transpose(0, 2, 1)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(seen)), dtype=np.float64)


def _angles(rays: Array, about: Array) -> Array:
    """Return (bearing · cos ε, elevation) (N, 2) of rays about others."""
    flat = np.hypot(about[:, 0], about[:, 1])
    cross = rays[:, 0] * about[:, 1] - rays[:, 1] * about[:, 0]
    along = rays[:, 0] * about[:, 0] + rays[:, 1] * about[:, 1]
    elevation = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
    return np.stack([np.arctan2(cross, along) * flat, elevation], axis=-1)
