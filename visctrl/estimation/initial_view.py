"""The initial view as the constrained tensor fit knows it, and what the drive tells about it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.planar import PlanarMotion
from visctrl.geometry.trifocal import Trilinear, current_view_basis, view_parameters
from visctrl.geometry.trifocal_fit import Coupling, Fit, coupling

Array = NDArray[np.float64]

#: Successive frames share the fixed views and their noise: after the first, this many count as
#: one, and all of them together as no more than so many of the best.
_ALIKE, _AT_MOST = 10.0, 2.0
#: Squared distance (in sigmas) up to which the bearings and the prior agree.
_AGREEMENT = 9.0


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
    def vector(self) -> Array:
        """(phi, bearing) as an array (2,)."""
        return np.array([self.phi, self.bearing])

    @cached_property
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


class InitialViewFilter:
    """Constants of a run, refined by what every current view says about them.

    The prior comes from the essential matrix of the initial and target views. It uses
    elevations, so a camera with a wrong ξ or focal length makes it wrong without its knowing;
    bearings do not suffer from either. So it counts for what it claims until the bearings of
    the drive contradict it, and for less afterwards.

    Parameters
    ----------
    prior : InitialView
        Where to start; infinite variances are allowed.

    Attributes
    ----------
    view : InitialView
        The best one so far.
    """

    def __init__(self, prior: InitialView) -> None:
        self.view = prior
        self.prior = prior
        variance = prior.covariance
        known = bool(np.isfinite(variance).all())
        self._prior_information = np.linalg.inv(variance) if known else np.zeros((2, 2))
        self._information = np.zeros((2, 2))
        # Deviations from the prior, which keeps angles away from their cut.
        self._weighted = np.zeros(2)
        self._best = 0.0

    def update(self, relation: Trilinear, fit: Fit) -> Coupling:
        """Take in one tick's fit, made with the present ``view``; return its coupling."""
        coupled = coupling(relation, fit, self.view.parameters, self.view.jacobian)
        first = not self._information.any()
        weight = 1.0 if first else 1.0 / _ALIKE
        deviation = self.view.vector - self.prior.vector
        self._information = self._information + weight * coupled.information
        self._weighted = self._weighted + weight * (
            coupled.information @ deviation + coupled.gradient
        )
        self._best = max(self._best, float(np.trace(coupled.information)))
        excess = float(np.trace(self._information)) / max(_AT_MOST * self._best, 1e-300)
        if excess > 1.0:
            self._information /= excess
            self._weighted /= excess
        self._fuse()
        return coupled

    def _fuse(self) -> None:
        """Combine the prior with the bearings, at the weight that it has left."""
        prior, bearings = self._prior_information, self._information
        total = prior + bearings
        if np.linalg.cond(total) > 1e12:
            return
        # What both together cannot explain of the bearings: dᵀ (Σ_prior + Σ_bearings)⁻¹ d.
        alone = np.linalg.pinv(bearings, hermitian=True) @ self._weighted
        distance2 = float(self._weighted @ (alone - np.linalg.solve(total, self._weighted)))
        doubt = max(1.0, 1.0 + distance2 - _AGREEMENT)
        covariance = np.asarray(np.linalg.inv(prior / doubt + bearings), dtype=np.float64)
        phi, bearing = self.prior.vector + covariance @ self._weighted
        self.view = InitialView(float(phi), float(bearing), covariance)
