"""Pose of the initial view by the source's procedures, after a short forward motion."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Views
from visctrl.geometry.trifocal.tensor import CALIBRATED, T111, T121, T211, T221
from visctrl.geometry.trifocal.transfer import bearings
from visctrl.geometry.two_view.planar import ransac_planar_motion
from visctrl.robots.unicycle import relative_pose, wrap_angle
from visctrl.schemes.pose.first_leg import Leg, in_front, scale_of
from visctrl.schemes.pose.measurements import measured_tensor

Array = NDArray[np.float64]


def initial_from_tensor(tensor: Array, distance: float) -> Array:
    """Return C1 (3,) in the target's frame from one tensor: the closed form of (4.16).

    Parameters
    ----------
    tensor : (8,) array
        Of the views in the order target, second, first, in any scale.
    distance : float
        Way straight ahead from the first to the second view (m).

    Returns
    -------
    (3,) array
        The tensor's sign is unknown, and C1 therefore up to half a turn about the target.
    """
    scale = distance / math.hypot(tensor[T111], tensor[T211])
    phi = math.atan2(scale * tensor[T111], scale * tensor[T211])
    tx, ty = -scale * tensor[T221], scale * tensor[T121]
    s, c = math.sin(phi), math.cos(phi)
    target = np.array([-tx * c + ty * s, -tx * s - ty * c, phi])
    return relative_pose(np.zeros(3), target)


def initial_by_tensor(views: Views, distance: float, seed: int) -> Array | str:
    """Return C1 (3,) from the three views after a leg straight ahead, or why it fails."""
    reordered = Views(
        ids=views.ids,
        target=views.initial,
        initial=views.target,
        current=views.current,
        pixels=views.pixels,
        sigma=views.sigma,
        stamp=views.stamp,
    )
    found = measured_tensor(reordered, CALIBRATED, refined=False, seed=seed)
    if isinstance(found, str):
        return found
    initial = initial_from_tensor(found[0], distance)
    angles = np.array([math.atan2(initial[0], -initial[1]), initial[2]])
    if not in_front(bearings(views.initial), bearings(views.target), angles[None])[0]:
        initial = np.array([-initial[0], -initial[1], wrap_angle(initial[2] + math.pi)])
    return initial


def initial_by_essential(views: Views, leg: Leg, seed: int) -> Array | str:
    """Return C1 (3,): directions from the planar essential matrix, the scale from the leg."""
    motion = ransac_planar_motion(views.target, views.initial, views.sigma, seed=seed)
    if not motion.determined:
        return motion.reason
    # Seen from the target, C1 lies at the bearing θ: (sin θ, cos θ) = (sin β, −cos β).
    beta = math.pi - motion.direction
    q, _ = scale_of(leg, np.array([beta]), np.array([motion.phi]))
    if not q[0] > 0.0:
        return "the forward motion does not show in the images"
    distance = 1.0 / float(q[0])
    return np.array([distance * math.sin(beta), -distance * math.cos(beta), motion.phi])
