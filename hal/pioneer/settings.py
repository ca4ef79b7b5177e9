"""What the robot is told before its motors are switched on. No I/O."""

from __future__ import annotations

import math

from visctrl.hal.pioneer.commands import Command, Id
from visctrl.hal.pioneer.config import UNLIMITED, Config
from visctrl.robots import Limits

#: Set-points of zero.
REST = (Command(Id.VEL, 0), Command(Id.RVEL, 0))
#: What stops the robot as hard as it can, for good.
BRAKE = (Command(Id.E_STOP), *REST)


def settings(limits: Limits, config: Config, *, sonar: bool) -> list[Command]:
    """Return the commands that take back old set-points and give the firmware our limits.

    Parameters
    ----------
    limits : Limits
        Speeds and accelerations that it shall keep; never above the firmware's own.
    config : Config
        What the firmware says of itself.
    sonar : bool
        Whether the sonar rings shall fire.
    """
    speed = _within(limits.v_m_s * 1e3, config.speed_top)
    turn = _within(limits.omega_deg_s, config.turn_top)
    ramp = _within(limits.acceleration_m_s2 * 1e3, config.acceleration_top)
    turn_ramp = _within(limits.angular_acceleration_deg_s2, config.turn_acceleration_top)
    return [
        *REST,
        Command(Id.SETV, speed),
        Command(Id.SETRV, turn),
        Command(Id.SETA, ramp),
        Command(Id.SETA, -ramp),
        Command(Id.SETRA, turn_ramp),
        Command(Id.SETRA, -turn_ramp),
        Command(Id.SONAR, int(sonar)),
    ]


def _within(value: float, top: int | None) -> int:
    """Return a limit in whole units, no higher than the firmware's own (0 and 9999: none)."""
    ceiling = top if top and top < UNLIMITED else UNLIMITED
    return max(1, min(math.ceil(value - 1e-9), ceiling))
