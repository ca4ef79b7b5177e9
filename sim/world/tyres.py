"""How the tyres of a skid-steered robot push it over the floor.

Turning, such a robot drags all four tyres sideways, and PyBullet's contact friction does not
settle that: measured turning rates vary between a tenth and 1.5 times the expected one with
speed and history. Here the wheels touch the floor without friction, and each tyre pushes with a
force against its slip, up to Coulomb's bound. For a force that is alike in all directions the
robot turns as if its track were t + 4 a²/t (t track, 2a wheelbase), at any speed and friction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from visctrl.sim.world.engine import pybullet

Array = NDArray[np.float64]

#: Force per slip speed of one tyre (N s/m); stiff, yet stable at the physics' step.
_STIFFNESS_N_S_M = 700.0
_FRICTION = 0.8
_GRAVITY_M_S2 = 9.81


class SkidTyres:
    """Tyre forces on a body.

    Parameters
    ----------
    client, body : int
        PyBullet client and body.
    feet : (N, 2) array
        Where the tyres touch the floor, in base coordinates (forward, left) (m).
    mass_kg : float
        Mass that they share.
    """

    def __init__(self, client: int, body: int, feet: Array, mass_kg: float) -> None:
        self._client = client
        self._body = body
        self._feet = feet
        self._bound = _FRICTION * mass_kg * _GRAVITY_M_S2 / len(feet)

    def push(self, speeds: Sequence[float]) -> None:
        """Apply one step's forces; ``speeds`` (m/s) are those of the tyres' surfaces."""
        options = {"physicsClientId": self._client}
        position, orientation = pybullet.getBasePositionAndOrientation(self._body, **options)
        linear, angular = pybullet.getBaseVelocity(self._body, **options)
        yaw = pybullet.getEulerFromQuaternion(orientation)[2]
        s, c = math.sin(yaw), math.cos(yaw)
        forward = c * linear[0] + s * linear[1]
        leftward = -s * linear[0] + c * linear[1]
        fx = fy = torque = 0.0
        for (x, y), speed in zip(self._feet.tolist(), speeds, strict=True):
            px, py = self._force(forward - angular[2] * y - speed, leftward + angular[2] * x)
            fx, fy, torque = fx + px, fy + py, torque + x * py - y * px
        force = [c * fx - s * fy, s * fx + c * fy, 0.0]
        foot = [position[0], position[1], 0.0]
        pybullet.applyExternalForce(self._body, -1, force, foot, pybullet.WORLD_FRAME, **options)
        pybullet.applyExternalTorque(
            self._body, -1, [0.0, 0.0, torque], pybullet.WORLD_FRAME, **options
        )

    def _force(self, slip_x: float, slip_y: float) -> tuple[float, float]:
        """Return the force (N) of one tyre that slips at (forward, left) m/s."""
        slip = math.hypot(slip_x, slip_y)
        gain = _STIFFNESS_N_S_M
        if gain * slip > self._bound:
            gain = self._bound / slip
        return -gain * slip_x, -gain * slip_y
