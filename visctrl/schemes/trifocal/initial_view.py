"""The initial view: found from elevations or bearings, and refined by what the drive tells."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Views
from visctrl.geometry.robust.symmetric import Symmetric2
from visctrl.geometry.trifocal.fit import Coupling, coupling, refine
from visctrl.geometry.trifocal.motions import motions_of_tensor, share_in_front
from visctrl.geometry.trifocal.solvers import identical_views, ransac_tensor
from visctrl.geometry.trifocal.tensor import (
    CALIBRATED,
    Trilinear,
    current_view_basis,
    trilinear,
    view_parameters,
)
from visctrl.geometry.two_view.planar import PlanarMotion
from visctrl.robots.unicycle import wrap_angle
from visctrl.schemes.path_scale import Point
from visctrl.schemes.trifocal.tensor_method import TensorOptions

Array = NDArray[np.float64]

#: Successive frames share the fixed views and their noise: after the first, this many count as
#: one, and all of them together as no more than so many of the best.
ALIKE, AT_MOST = 10.0, 2.0
#: Squared distance (in sigmas) up to which the bearings and the prior agree.
AGREEMENT = 9.0
#: What is known badly enough to count as unknown: condition number of the information.
CONDITION = 1e12
#: The initial view counts as known when its heading and bearing are this certain (rad).
_CERTAIN = math.radians(4.0)
#: A motion is physical when this share of the features lies in front of all views.
_IN_FRONT = 0.7
_NONE = Symmetric2(0.0, 0.0, 0.0)


class InitialView:
    """Heading of the initial view and the direction in which it sees the target.

    Parameters
    ----------
    phi, bearing : float
        φ1, and where the target is seen (rad, clockwise from forward). The unit of length is the
        distance to the target.
    covariance : (2, 2) array
        Of (phi, bearing) (rad²).

    Attributes
    ----------
    target : (right, forward)
        The target's position, of unit length.
    parameters : (4,) array
        See `visctrl.geometry.trifocal.tensor.view_parameters`.
    jacobian : (4, 2) array
        Derivative of ``parameters`` by (phi, bearing).
    basis : (8, 4) array
        The tensors that have this initial view.
    """

    def __init__(self, phi: float, bearing: float, covariance: Array) -> None:
        self.phi, self.bearing, self.covariance = phi, bearing, covariance
        s, c = math.sin(phi), math.cos(phi)
        right, forward = self.target = math.sin(bearing), math.cos(bearing)
        self.parameters = np.array([c, s, right, forward])
        self.jacobian = np.array([[-s, 0.0], [c, 0.0], [0.0, forward], [0.0, -right]])
        self.basis = current_view_basis(self.parameters)

    @classmethod
    def of(cls, motion: PlanarMotion) -> InitialView:
        """Return the initial view from the planar motion initial → target."""
        # The target's heading seen from the initial view is −φ1.
        sign = np.array([-1.0, 1.0])
        return cls(-motion.phi, motion.direction, motion.covariance * np.outer(sign, sign))


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
        known = bool(np.isfinite(prior.covariance).all())
        self._prior_information = Symmetric2.of(prior.covariance).inverse() if known else _NONE
        self._information = _NONE
        # Deviations from the prior, which keeps angles away from their cut.
        self._weighted = (0.0, 0.0)
        self._best = 0.0

    def update(self, coupled: Coupling) -> None:
        """Take in what one tick's fit, made with the present ``view``, says about it."""
        information = Symmetric2.of(coupled.information)
        weight = 1.0 if self._information == _NONE else 1.0 / ALIKE
        pull = information.apply(
            (self.view.phi - self.prior.phi, self.view.bearing - self.prior.bearing)
        )
        gradient = coupled.gradient.tolist()
        self._information = self._information.plus(information, weight)
        self._weighted = (
            self._weighted[0] + weight * (pull[0] + gradient[0]),
            self._weighted[1] + weight * (pull[1] + gradient[1]),
        )
        self._best = max(self._best, information.trace)
        excess = self._information.trace / max(AT_MOST * self._best, 1e-300)
        if excess > 1.0:
            self._information = self._information.times(1.0 / excess)
            self._weighted = (self._weighted[0] / excess, self._weighted[1] / excess)
        self._fuse()

    def _fuse(self) -> None:
        """Combine the prior with the bearings, at the weight that it has left."""
        prior, bearings = self._prior_information, self._information
        total = prior.plus(bearings)
        small, large = total.eigenvalues
        if small * CONDITION < large or large <= 0.0:
            return
        # What both together cannot explain of the bearings: dᵀ (Σ_prior + Σ_bearings)⁻¹ d.
        x, y = self._weighted
        alone = bearings.pseudo_inverse().apply(self._weighted)
        together = total.inverse().apply(self._weighted)
        distance2 = x * (alone[0] - together[0]) + y * (alone[1] - together[1])
        doubt = max(1.0, 1.0 + distance2 - AGREEMENT)
        covariance = bearings.plus(prior, 1.0 / doubt).inverse()
        phi, bearing = covariance.apply(self._weighted)
        self.view = InitialView(
            self.prior.phi + phi, self.prior.bearing + bearing, covariance.array
        )


@dataclass(frozen=True)
class Undetermined:
    """Why the initial view is not known yet."""

    reason: str


class InitialFromBearings:
    """Takes the motion out of a calibrated tensor, without elevations.

    A tensor stands for two motions; what the robot was told to drive decides between them.
    """

    def __init__(self, options: TensorOptions, seed: int) -> None:
        self._options = options
        self._seed = seed

    def find(
        self, views: Views, driven: Point, turned: float, guess: InitialView | None = None
    ) -> InitialView | Undetermined:
        """Return the initial view, or why it is not known yet.

        driven, turned : dead-reckoned position in m and heading (rad) in the initial
        view's frame.
        guess : what else is known of the initial view, to choose by.
        """
        if identical_views(views.initial, views.current, views.sigma):
            return Undetermined("initial and current view are identical: the robot has to move")
        relation = trilinear(views.initial, views.current, views.target)
        within = relation.within(CALIBRATED)
        if len(relation) < within.error.shape[1]:
            return Undetermined(f"too few features: {len(relation)}")
        z, inliers = ransac_tensor(
            within,
            views.sigma,
            seed=self._seed,
            threshold_sigmas=self._options.threshold_sigmas,
            hypotheses=self._options.hypotheses,
        )
        if inliers.mean() < self._options.min_inliers:
            return Undetermined(
                f"features disagree: {int(inliers.sum())} of {len(views)} on a tensor"
            )
        fit = refine(within.take(inliers), z, views.sigma)
        motions = motions_of_tensor(CALIBRATED @ fit.z)
        front = share_in_front(
            motions, views.initial[inliers], views.current[inliers], views.target[inliers]
        )
        physical = motions[front >= _IN_FRONT]
        if not len(physical):
            return Undetermined("no motion has the features in front of the camera")
        mismatch = _mismatch(physical, driven, turned)
        if guess is not None:
            bearing = np.arctan2(physical[:, 0, 1], physical[:, 0, 2])
            mismatch += np.abs(wrap_angle(physical[:, 0, 0] - guess.phi))
            mismatch += np.abs(wrap_angle(bearing - guess.bearing))
        best = physical[np.argmin(mismatch)]
        return _judged(relation.take(inliers), best, views.sigma)


def _mismatch(motions: Array, driven: Point, turned: float) -> Array:
    """Return how far (rad) motions (M, 2, 3) are from what was driven: turn and direction."""
    turn = motions[:, 1, 0] - motions[:, 0, 0]
    s, c = np.sin(turn), np.cos(turn)
    x, y = motions[:, 1, 1], motions[:, 1, 2]
    moved = motions[:, 0, 1:] - np.stack([c * x - s * y, s * x + c * y], axis=-1)
    direction = np.arctan2(moved[:, 0], moved[:, 1]) - math.atan2(*driven)
    return np.asarray(np.abs(wrap_angle(turn - turned)) + np.abs(wrap_angle(direction)))


def _judged(relation: Trilinear, motion: Array, sigma: float) -> InitialView | Undetermined:
    """Return the initial view of a motion (2, 3) if the features determine it well enough."""
    (phi, x, y), (phi_2, x_2, y_2) = motion
    # Without a prior of its own: the bearings are taken into the filter as they come.
    view = InitialView(float(phi), float(math.atan2(x, y)), np.diag([np.inf, np.inf]))
    fit = refine(relation.within(view.basis), view_parameters(phi_2, np.array([x_2, y_2])), sigma)
    information = coupling(relation, fit, view.parameters, view.jacobian).information
    if float(np.linalg.eigvalsh(information)[0]) * _CERTAIN**2 < 1.0:
        return Undetermined(
            "bearings do not determine the initial view yet: the robot has to move on"
        )
    return view
