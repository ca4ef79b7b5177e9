"""The initial view from bearings alone, once the robot has moved."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Views
from visctrl.geometry.trifocal.fit import coupling, refine
from visctrl.geometry.trifocal.motions import motions_of_tensor, share_in_front
from visctrl.geometry.trifocal.solvers import identical_views, ransac_tensor
from visctrl.geometry.trifocal.tensor import (
    CALIBRATED,
    Trilinear,
    trilinear,
    view_parameters,
)
from visctrl.robots.unicycle import wrap_angle
from visctrl.schemes.path_scale import Point
from visctrl.schemes.trifocal.initial_view import InitialView
from visctrl.schemes.trifocal.tensor_method import TensorOptions

Array = NDArray[np.float64]

#: The initial view counts as known when its heading and bearing are this certain (rad).
_CERTAIN = math.radians(4.0)
#: A motion is physical when this share of the features lies in front of all views.
_IN_FRONT = 0.7


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
