"""What one-phase trifocal laws do before they steer: drive until tensor, φ1 and scale are known."""

from __future__ import annotations

import math
from typing import NamedTuple

from visctrl.contracts import Health
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.schemes.termination import Divergence
from visctrl.schemes.trifocal.estimate import TensorEstimate
from visctrl.schemes.trifocal.initial_heading import InitialHeading
from visctrl.schemes.trifocal.law import TrifocalState

#: Speed until the tensor's scale is known (m/s), and how well it must be known.
BLIND_SPEED, _KNOWN_SCALE = 0.2, 0.1
#: It does not wait for that longer than this (m).
_LONGEST_WAIT_M = 0.5
#: Without any tensor the robot goes straight ahead no farther than this (m).
_BLIND_LEG_M = 0.4
#: So many times the initial distance away, and so much farther (m), the robot gives up.
_ASTRAY, _LEEWAY_M = 2.0, 1.0


class Reading(NamedTuple):
    """What an estimate is good for.

    state : None where the law must not steer by it but send ``velocity``.
    advancing : that velocity is the leg on which φ1 shows.
    """

    state: TrifocalState | None
    velocity: Velocity = STANDSTILL
    advancing: bool = False


class Intake:
    """Turns estimates into states, or into the velocity that makes one known.

    Parameters
    ----------
    offset : float
        The camera ahead of the axle (m).
    """

    def __init__(self, offset: float) -> None:
        self._offset = offset
        self._divergence = Divergence(_ASTRAY, _LEEWAY_M)
        self._blind = self._driven = 0.0
        self._initial_heading = InitialHeading()
        #: Whether the scale is known as well as it must be.
        self.known = False

    @property
    def begun(self) -> bool:
        """Whether the initial distance has been taken."""
        return self._divergence.begun

    def begin(self, distance_m: float) -> None:
        """Take a distance as the initial one."""
        self._divergence.begin(distance_m)

    def read(self, estimate: TensorEstimate, sent: Velocity, dt: float) -> Reading:
        """Take an estimate; what was ``sent`` has acted for ``dt`` (s)."""
        if estimate.health is Health.DEGENERATE and not self.begun:
            # Some tensors are determined only once the robot has moved.
            self._blind += abs(sent.v) * dt
            ahead = Velocity(BLIND_SPEED, 0.0) if self._blind < _BLIND_LEG_M else STANDSTILL
            return Reading(None, ahead)
        if estimate.health is not Health.OK:
            return Reading(None)
        self._driven += abs(sent.v) * dt
        told = self._initial_heading.known(estimate)
        if told is None:
            return Reading(None, Velocity(BLIND_SPEED, 0.0), advancing=True)
        state = TrifocalState.of(told, self._offset)
        distance = state.scale * math.hypot(state.right, state.forward)
        sure = estimate.scale_sd_m < _KNOWN_SCALE * state.scale
        self.known = sure or self._driven > _LONGEST_WAIT_M
        if self.known and not self.begun:
            self.begin(distance)
        return Reading(None) if self._divergence.astray(distance) else Reading(state)
