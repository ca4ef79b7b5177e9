"""The preliminary manoeuvre: from where no direct motion serves to a general configuration.

Three kinds of start have none. With the three views in a line the depth cannot be told from the
epipoles; with a lateral error only, the way to the target is across its axis; with the target
behind, the robot would have to come back. In each, the robot turns, drives until the direction
ψ to the target lies in the band that the direct motion serves, and hands over.
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Annotated, NamedTuple

from pydantic import Field

from visctrl.hal.types import Velocity
from visctrl.robots.documents import StrictModel
from visctrl.robots.unicycle import wrap_angle
from visctrl.schemes.epipolar.estimate import Location

Positive = Annotated[float, Field(gt=0)]


class Polar(NamedTuple):
    """Pose about the target: distance ρ (units of D), direction ψ to it and heading φ (rad)."""

    rho: float
    psi: float
    phi: float


def polar(location: Location, camera_forward_m: float) -> Polar:
    """Return the polar form of the axle's pose about the axle's pose at the target.

    The axle obeys the unicycle's equations without an offset, and both poses coincide exactly
    when the camera's do.
    """
    lever = camera_forward_m * location.inverse_distance
    x = location.x + lever * math.sin(location.phi)
    y = location.y + lever * (1.0 - math.cos(location.phi))
    return Polar(math.hypot(x, y), math.atan2(x, -y), location.phi)


class Kind(StrEnum):
    """Why a start needs a manoeuvre."""

    ALIGNED = "aligned"
    LATERAL = "lateral"
    BEHIND = "behind"


class ManoeuvreOptions(StrictModel):
    """Options of the manoeuvre.

    aligned_deg : |ψ| under which the three views count as aligned.
    lateral_deg : |ψ| above which the error counts as lateral.
    leave_deg, enter_deg : |ψ| that the drive from an aligned, or from a lateral or passed,
        target has to reach.
    turn_deg : heading off the target's direction (aligned) or axis (passed) while driving.
    rate : speed of the drive in first distances per second.
    turn_gain : of the heading error (1/s).
    omega_deg_s : bound of the turning rate.
    """

    aligned_deg: Positive = 4.0
    lateral_deg: Positive = 55.0
    leave_deg: Positive = 11.0
    enter_deg: Positive = 38.0
    turn_deg: Positive = 35.0
    rate: Positive = 0.2
    turn_gain: Positive = 1.5
    omega_deg_s: Positive = 30.0


class Manoeuvre:
    """One manoeuvre, decided at the start.

    Parameters
    ----------
    options : ManoeuvreOptions
        Bands and speeds.
    first : Polar
        Pose at the start.
    field_rad : float
        Half of the camera's horizontal field of view: the target's scene stays inside.
    """

    #: Turned enough to drive (rad).
    _TURNED = math.radians(4.0)

    def __init__(self, options: ManoeuvreOptions, first: Polar, field_rad: float) -> None:
        self._options = options
        self.kind = _kind(options, first.psi)
        side = math.copysign(1.0, first.psi)
        turn = min(math.radians(options.turn_deg), 0.8 * field_rad)
        # The approach from there turns the camera by about twice ψ off the target's axis.
        self._enter = min(math.radians(options.enter_deg), 0.5 * field_rad)
        if self.kind is Kind.ALIGNED:
            self._heading, self._reverse = first.psi + side * turn, False
        elif abs(math.sin(first.psi)) < math.sin(math.radians(options.aligned_deg)):
            # Straight past the target: reverse at an angle, or the views stay aligned.
            self._heading, self._reverse = side * self._enter / 2.0, True
        else:
            self._heading, self._reverse = 0.0, True
        self._driving = False
        self.done = self.kind is None

    def update(self, now: Polar, inverse_distance: float) -> Velocity:
        """Return the next velocity; `done` tells whether the manoeuvre is over."""
        o = self._options
        self.done = self.done or self._arrived(now)
        error = float(wrap_angle(now.phi - self._heading))
        self._driving = self._driving or abs(error) < self._TURNED
        bound = math.radians(o.omega_deg_s)
        omega = max(-bound, min(bound, -o.turn_gain * error))
        v = o.rate / inverse_distance if self._driving else 0.0
        return Velocity(-v if self._reverse else v, omega)

    def _arrived(self, now: Polar) -> bool:
        off = abs(now.psi)
        if self.kind is Kind.ALIGNED:
            return off > math.radians(self._options.leave_deg)
        return off < self._enter


def _kind(options: ManoeuvreOptions, psi: float) -> Kind | None:
    off = abs(psi)
    if off > math.pi / 2.0:
        return Kind.BEHIND
    if off > math.radians(options.lateral_deg):
        return Kind.LATERAL
    return Kind.ALIGNED if off < math.radians(options.aligned_deg) else None
