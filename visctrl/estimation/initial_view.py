"""The initial view as the constrained tensor fit knows it: constants of a run."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.planar import PlanarMotion
from visctrl.geometry.trifocal import current_view_basis, view_parameters

Array = NDArray[np.float64]


@dataclass(frozen=True)
class InitialView:
    """Heading of the initial view and the direction in which it sees the target.

    phi : φ1 (rad); bearing : of the target (rad, clockwise from forward). The unit of length is
    the distance to the target.
    covariance : (2, 2), of (phi, bearing) (rad²).
    """

    phi: float
    bearing: float
    covariance: Array

    @classmethod
    def of(cls, motion: PlanarMotion) -> InitialView:
        """Return the initial view from the planar motion initial → target."""
        # The target's heading seen from the initial view is −φ1.
        sign = np.array([-1.0, 1.0])
        return cls(-motion.phi, motion.direction, motion.covariance * np.outer(sign, sign))

    @property
    def target(self) -> Array:
        """The target's position (right, forward), of unit length."""
        return np.array([np.sin(self.bearing), np.cos(self.bearing)])

    @cached_property
    def parameters(self) -> Array:
        """(4,): see `visctrl.geometry.trifocal.view_parameters`."""
        return view_parameters(self.phi, self.target)

    @cached_property
    def jacobian(self) -> Array:
        """Derivative (4, 2) of ``parameters`` by (phi, bearing)."""
        J = np.zeros((4, 2))
        J[:2, 0] = -np.sin(self.phi), np.cos(self.phi)
        J[2:, 1] = np.cos(self.bearing), -np.sin(self.bearing)
        return J

    @cached_property
    def basis(self) -> Array:
        """(8, 4): the tensors that have this initial view."""
        return current_view_basis(self.parameters)
