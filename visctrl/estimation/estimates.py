"""What the estimators of the planar geometry deliver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.planar import PlanarMotion
from visctrl.geometry.trifocal import T111, T112, T121, T122, T211, T212, T221, T222
from visctrl.plugins import Estimate

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class PlanarMotionEstimate(Estimate):
    """The target's pose seen from the current one, up to the distance.

    motion : view A is the current one, view B the target; ``motion.direction`` is the bearing
        of the target (rad, clockwise from forward), ``motion.phi`` its heading in the current
        frame (rad).
    """

    motion: PlanarMotion

    @property
    def bearing(self) -> float:
        """Bearing of the target (rad, clockwise from forward)."""
        return self.motion.direction

    @property
    def bearing_sd(self) -> float:
        """Standard deviation of the bearing (rad)."""
        return self.motion.direction_sd


@dataclass(frozen=True, kw_only=True)
class TensorEstimate(Estimate):
    """The 1D trifocal tensor of the initial, current and target view.

    elements : (8,) T111, T112, T121, T122, T211, T212, T221, T222 over T121.
    covariance : (8, 8) of the elements, first order.
    phi_1 : heading of the initial view in the target's frame (rad), as the law is to use it.
    phi_1_sd : its standard deviation (rad); infinite where it is a mere assumption.
    scale_m : metric value of T121, T_N (m); negative where the robot is known to have turned
        so far from the target's heading that T121 has changed its sign.
    scale_sd_m : its standard deviation (m); infinite while it is a mere guess.
    """

    elements: Array
    covariance: Array
    phi_1: float
    phi_1_sd: float
    scale_m: float
    scale_sd_m: float

    @property
    def outputs(self) -> Array:
        """ξ1 = T112 + T121 and ξ2 = T212 + T221, both 0 at the target's position (2,)."""
        T = self.elements
        return np.array([T[T112] + T[T121], T[T212] + T[T221]])

    @property
    def outputs_covariance(self) -> Array:
        """Covariance (2, 2) of ``outputs``."""
        J = np.zeros((2, 8))
        J[0, [T112, T121]] = J[1, [T212, T221]] = 1.0
        return np.asarray(J @ self.covariance @ J.T)

    @property
    def target(self) -> Array:
        """Target's position (right, forward) from the current pose, in units of T121 (2,).

        The outputs turned by φ1, which is why both vanish at the target.
        """
        s, c = np.sin(self.phi_1), np.cos(self.phi_1)
        xi_1, xi_2 = self.outputs
        return np.array([c * xi_2 + s * xi_1, c * xi_1 - s * xi_2])

    @property
    def target_sd(self) -> Array:
        """Standard deviations (2,) of ``target``."""
        s, c = np.sin(self.phi_1), np.cos(self.phi_1)
        R = np.array([[s, c], [c, -s]])
        return np.asarray(np.sqrt(np.maximum(np.diag(R @ self.outputs_covariance @ R.T), 0.0)))

    @property
    def bearing(self) -> float:
        """Bearing of the target from the current pose (rad, clockwise from forward)."""
        right, forward = self.target * np.sign(self.scale_m)
        return float(np.arctan2(right, forward))

    @property
    def distance_m(self) -> float:
        """Distance to the target's position (m)."""
        return float(abs(self.scale_m) * np.hypot(*self.outputs))

    @property
    def heading(self) -> float:
        """Heading of the current view in the target's frame (rad), from T and φ1.

        With t_2 known from the outputs, T_1jk and T_2jk hold t_1 turned by φ2; that vector's
        longer component is t_y1 in every task, so its sign is known.
        """
        T, s, c = self.elements, np.sin(self.phi_1), np.cos(self.phi_1)
        right, forward = self.target
        sine = T[T111] + forward * s + T[T122] + right * c
        cosine = T[T121] - right * s - T[T112] + forward * c
        sign = np.sign(self.scale_m)
        return float(np.arctan2(sign * sine, sign * cosine))

    @property
    def determinant(self) -> float:
        """(T111 − T122) sin φ1 + (T211 − T222) cos φ1: T_N times the decoupling matrix's (3.9).

        It is minus the target's forward distance in units of T121.
        """
        T, s, c = self.elements, np.sin(self.phi_1), np.cos(self.phi_1)
        return float((T[T111] - T[T122]) * s + (T[T211] - T[T222]) * c)
