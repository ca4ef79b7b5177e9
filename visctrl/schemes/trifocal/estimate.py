"""What the estimators of the planar geometry deliver."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Estimate
from visctrl.geometry.robust.symmetric import Pair, Symmetric2
from visctrl.geometry.trifocal.tensor import T111, T112, T121, T122, T211, T212, T221, T222
from visctrl.geometry.two_view.planar import PlanarMotion

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
    def outputs(self) -> Pair:
        """ξ1 = T112 + T121 and ξ2 = T212 + T221, both 0 at the target's position."""
        T = self._numbers
        return T[T112] + T[T121], T[T212] + T[T221]

    @property
    def outputs_covariance(self) -> Symmetric2:
        """Covariance of ``outputs``."""
        C = self.covariance
        first, second = (C[T112] + C[T121]).tolist(), (C[T212] + C[T221]).tolist()
        return Symmetric2(
            first[T112] + first[T121], first[T212] + first[T221], second[T212] + second[T221]
        )

    @property
    def target(self) -> Pair:
        """Target's position (right, forward) from the current pose, in units of T121.

        The outputs turned by φ1, which is why both vanish at the target.
        """
        s, c = math.sin(self.phi_1), math.cos(self.phi_1)
        xi_1, xi_2 = self.outputs
        return c * xi_2 + s * xi_1, c * xi_1 - s * xi_2

    @property
    def target_sd(self) -> Pair:
        """Standard deviations of ``target``."""
        s, c = math.sin(self.phi_1), math.cos(self.phi_1)
        a, b, d = self.outputs_covariance
        right = s * s * a + 2.0 * s * c * b + c * c * d
        forward = c * c * a - 2.0 * s * c * b + s * s * d
        return math.sqrt(max(right, 0.0)), math.sqrt(max(forward, 0.0))

    @property
    def bearing(self) -> float:
        """Bearing of the target from the current pose (rad, clockwise from forward)."""
        right, forward = self.target
        sign = self._sign
        return math.atan2(sign * right, sign * forward)

    @property
    def distance_m(self) -> float:
        """Distance to the target's position (m)."""
        return abs(self.scale_m) * math.hypot(*self.outputs)

    @property
    def heading(self) -> float:
        """Heading of the current view in the target's frame (rad), from T and φ1.

        With t_2 known from the outputs, T_1jk and T_2jk hold t_1 turned by φ2; that vector's
        longer component is t_y1 in every task, so its sign is known.
        """
        T, s, c = self._numbers, math.sin(self.phi_1), math.cos(self.phi_1)
        right, forward = self.target
        sine = T[T111] + forward * s + T[T122] + right * c
        cosine = T[T121] - right * s - T[T112] + forward * c
        return math.atan2(self._sign * sine, self._sign * cosine)

    @property
    def determinant(self) -> float:
        """(T111 − T122) sin φ1 + (T211 − T222) cos φ1: T_N times the decoupling matrix's (3.9).

        It is minus the target's forward distance in units of T121.
        """
        T, s, c = self._numbers, math.sin(self.phi_1), math.cos(self.phi_1)
        return (T[T111] - T[T122]) * s + (T[T211] - T[T222]) * c

    @property
    def _numbers(self) -> list[float]:
        """The elements as plain numbers."""
        return list(self.elements.tolist())

    @property
    def _sign(self) -> float:
        return math.copysign(1.0, self.scale_m)
