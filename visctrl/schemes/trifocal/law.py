"""The sliding-mode law on the normalised trifocal tensor: both steps, without time keeping.

Outputs ξ1 = T112 + T121, ξ2 = T212 + T221 vanish at the target's position, whatever the
heading. Turned by φ1 they are the target's position in the robot's axes, (right, forward) =
(b, a) in units of T_N, and (3.7) becomes a' = −v/T_N − b ω, b' = a ω: the decoupling matrix is
singular where the target is abeam, a = 0, so also at the goal.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from visctrl.geometry.trifocal.tensor import T112, T121, T122, T211, T212, T221, T222
from visctrl.hal.types import Velocity
from visctrl.schemes.sliding_mode import switching
from visctrl.schemes.trifocal.estimate import TensorEstimate

#: Largest curvature of step 1 (1/m), and the turning rate allowed at a standstill (rad/s).
CURVATURE, FREE_TURN = 2.5, 0.03


class Gains(NamedTuple):
    """Parameters of the law; rates in 1/s, the rest dimensionless unless said."""

    lambda_1: float
    lambda_2: float
    kappa_1: float
    kappa_2: float
    boundary_layer: float
    threshold: float
    damping: float
    k_v_m_s: float
    k_omega_rad_s: float
    lambda_omega: float


class Outputs(NamedTuple):
    """ξ1, ξ2, or their references or rates."""

    xi_1: float
    xi_2: float


class TrifocalState(NamedTuple):
    """What the law reads off an estimate.

    right, forward : target's position in units of T_N; lateral_sd : sd of the former.
    scale : T_N (m). heading : of the robot in the target's frame (rad).
    """

    outputs: Outputs
    right: float
    forward: float
    lateral_sd: float
    phi_1: float
    phi_1_sd: float
    scale: float
    heading: float
    determinant: float
    tilt: float
    gap: float

    @classmethod
    def of(cls, estimate: TensorEstimate, offset: float) -> TrifocalState:
        """Read an estimate; ``offset`` is the camera ahead of the axle (m).

        The law moves the axle's centre, so an offset camera's target is replaced by that of
        the axle: turning on the spot then keeps the position reached.
        """
        # Dividing by T121 hides its sign; where the estimate knows it, it is put back.
        sign = math.copysign(1.0, estimate.scale_m)
        T: list[float] = (estimate.elements * sign).tolist()
        scale = abs(estimate.scale_m)
        xi_1, xi_2 = T[T112] + T[T121], T[T212] + T[T221]
        s, c = math.sin(estimate.phi_1), math.cos(estimate.phi_1)
        heading = estimate.heading
        right, forward = c * xi_2 + s * xi_1, c * xi_1 - s * xi_2
        if offset != 0.0:
            lever = offset / scale
            right -= lever * math.sin(heading)
            forward += lever * (1.0 - math.cos(heading))
            xi_1, xi_2 = c * forward + s * right, c * right - s * forward
        return cls(
            Outputs(xi_1, xi_2),
            right,
            forward,
            estimate.target_sd[0],
            estimate.phi_1,
            estimate.phi_1_sd,
            scale,
            heading,
            estimate.determinant * sign,
            T[T122] / T[T112] if T[T112] != 0.0 else 0.0,
            T[T222] - T[T211],
        )


def decoupled(seen: TrifocalState, rates: Outputs, damping: float) -> Velocity:
    """Return M⁻¹ (ξ1', ξ2') (3.9), with ω damped where M becomes singular (damping > 0)."""
    s, c = math.sin(seen.phi_1), math.cos(seen.phi_1)
    forward_rate = c * rates.xi_1 - s * rates.xi_2
    right_rate = c * rates.xi_2 + s * rates.xi_1
    omega = right_rate * seen.forward / (seen.forward**2 + damping**2)
    return Velocity(-seen.scale * (forward_rate + seen.right * omega), omega)


def position_step(
    seen: TrifocalState, reference: Outputs, reference_rate: Outputs, gains: Gains
) -> Velocity:
    """Return the velocity of step 1: tracking of the references (3.7)–(3.10)."""
    s_1, s_2 = seen.outputs.xi_1 - reference.xi_1, seen.outputs.xi_2 - reference.xi_2
    if abs(seen.determinant) < gains.threshold:
        return bounded(s_1, s_2, seen, gains)
    layer = gains.boundary_layer
    rates = Outputs(
        reference_rate.xi_1 - gains.kappa_1 * switching(s_1, layer) - gains.lambda_1 * s_1,
        reference_rate.xi_2 - gains.kappa_2 * switching(s_2, layer) - gains.lambda_2 * s_2,
    )
    return decoupled(seen, rates, gains.damping)


def bounded(s_1: float, s_2: float, seen: TrifocalState, gains: Gains) -> Velocity:
    """Return the bounded law near the singularity (3.10)."""
    layer = gains.boundary_layer
    return Velocity(
        gains.k_v_m_s * switching(s_1, layer),
        -gains.k_omega_rad_s * switching(s_2 * seen.gap, layer * abs(seen.gap)),
    )


def orientation_step(seen: TrifocalState, gains: Gains) -> Velocity:
    """Return the velocity of step 2 as published: (3.12), and the bounded v on ξ1."""
    v = gains.k_v_m_s * switching(seen.outputs.xi_1, gains.boundary_layer)
    return Velocity(v, gains.lambda_omega * seen.tilt)


def without_spinning(wanted: Velocity) -> Velocity:
    """Bound a velocity's curvature: turning faster than driving does not close a lateral error.

    Close to the goal the lateral error over the small distance left orders violent turns, which
    end in a heading far off and, with an imperfect calibration, in a new lateral error.
    """
    most = FREE_TURN + CURVATURE * abs(wanted.v)
    return Velocity(wanted.v, max(-most, min(most, wanted.omega)))


def settling_step(seen: TrifocalState, gains: Gains) -> Velocity:
    """Return the velocity of step 2 on angles and metres: proportional, without a dead band.

    While it turns, the robot keeps nulling what forward error there is.
    """
    return Velocity(seen.scale * gains.lambda_1 * seen.forward, -gains.lambda_omega * seen.heading)
