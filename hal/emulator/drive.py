"""How the emulated firmware turns set-points into wheel motion: ramps, limits, positions."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from visctrl.hal.types import STANDSTILL, Pose, Velocity
from visctrl.robots.unicycle import along_arc, wrap_angle

#: Closer than this to a heading (rad) or a distance (m) counts as there.
_HEADING_REACHED = math.radians(0.1)
_DISTANCE_REACHED = 0.001


@dataclass(frozen=True)
class Ramps:
    """Bounds on speed and acceleration (SI) in one degree of freedom."""

    speed: float
    acceleration: float
    deceleration: float

    def towards(self, value: float, goal: float, dt: float) -> float:
        """Return ``value`` moved towards ``goal`` for ``dt`` (s)."""
        goal = max(-self.speed, min(self.speed, goal))
        speeding_up = abs(goal) > abs(value) and goal * value >= 0.0
        step = (self.acceleration if speeding_up else self.deceleration) * dt
        return goal if abs(goal - value) <= step else value + math.copysign(step, goal - value)

    def approach(self, distance: float) -> float:
        """Return the speed from which a standstill ``distance`` away can just be reached."""
        return math.copysign(
            min(self.speed, math.sqrt(2.0 * self.deceleration * abs(distance))), distance
        )


class Drive:
    """Wheels with their velocity loops, and the poses that they lead to.

    Poses are those of the axle's centre: x right, y forward, φ counter-clockwise.

    Parameters
    ----------
    start : Pose
        Where the robot stands.
    translation, rotation : Ramps
        The firmware's settings at power-up.
    brake_m_s2, brake_rad_s2 : float
        The hardest deceleration that the motors can give.
    slip : Velocity
        Fractions of v and ω that the wheels turn but the robot does not follow.
    """

    def __init__(
        self,
        start: Pose,
        translation: Ramps,
        rotation: Ramps,
        brake_m_s2: float,
        brake_rad_s2: float,
        slip: Velocity = STANDSTILL,
    ) -> None:
        self._factory = (translation, rotation)
        self.translation, self.rotation = translation, rotation
        self._brakes = (brake_m_s2, brake_rad_s2)
        self._slip = slip
        self.true_pose = start
        self.wheel_pose = Pose(0.0, 0.0, 0.0)
        #: v and ω integrated (m, rad), for the encoders.
        self.run = (0.0, 0.0)
        self.velocity = STANDSTILL
        self.set_point = STANDSTILL
        self._heading: float | None = None
        self._distance: float | None = None

    # --- set-points --------------------------------------------------------------------------

    def set_speed(self, v: float) -> None:
        """Drive at ``v`` (m/s)."""
        self._distance = None
        self.set_point = Velocity(v, self.set_point.omega)

    def set_turn(self, omega: float) -> None:
        """Turn at ``omega`` (rad/s)."""
        self._heading = None
        self.set_point = Velocity(self.set_point.v, omega)

    def move(self, distance: float) -> None:
        """Drive ``distance`` (m) from here and stop."""
        self._distance = distance

    def head(self, heading: float) -> None:
        """Turn to ``heading`` (rad) of the odometry and stay there."""
        self._heading = heading

    @property
    def heading_goal(self) -> float:
        """The heading that is held or turned to (rad)."""
        return self.wheel_pose.phi if self._heading is None else self._heading

    def rest(self) -> None:
        """Forget all set-points."""
        self.set_point = STANDSTILL
        self._heading = self._distance = None

    def restore_ramps(self) -> None:
        """Return to the settings of power-up, as at the end of a session."""
        self.translation, self.rotation = self._factory

    def set_ramps(self, **changes: float) -> None:
        """Change some of v, omega, acceleration, deceleration (``turn_`` for the rotation's)."""
        names = {"speed", "acceleration", "deceleration"}
        linear = {name: value for name, value in changes.items() if name in names}
        turning = {
            name.removeprefix("turn_"): value
            for name, value in changes.items()
            if name.startswith("turn_")
        }
        self.translation = replace(self.translation, **linear)
        self.rotation = replace(self.rotation, **turning)

    def reset_odometry(self) -> None:
        """Set the wheels' pose to zero (SETO)."""
        self.wheel_pose = Pose(0.0, 0.0, 0.0)
        self._heading = None

    # --- motion --------------------------------------------------------------------------------

    @property
    def standing(self) -> bool:
        """Whether the wheels are at rest."""
        return self.velocity == STANDSTILL

    def brake(self, dt: float) -> None:
        """Move on for ``dt`` (s) with the motors braking as hard as they can."""
        v, omega = self.velocity
        self._roll(
            Velocity(_reduced(v, self._brakes[0] * dt), _reduced(omega, self._brakes[1] * dt)), dt
        )

    def follow(self, dt: float) -> None:
        """Move on for ``dt`` (s) along the ramps."""
        goal = self._goal()
        v, omega = self.velocity
        self._roll(
            Velocity(
                self.translation.towards(v, goal.v, dt),
                self.rotation.towards(omega, goal.omega, dt),
            ),
            dt,
        )

    def block(self) -> None:
        """Stop at once: the wheels are held fast from outside."""
        self.velocity = STANDSTILL

    def _goal(self) -> Velocity:
        v, omega = self.set_point
        if self._distance is not None:
            v = self.translation.approach(self._distance)
            if abs(self._distance) < _DISTANCE_REACHED:
                v, self._distance = 0.0, None
                self.set_point = Velocity(0.0, omega)
        if self._heading is not None:
            error = float(wrap_angle(self._heading - self.wheel_pose.phi))
            omega = 0.0 if abs(error) < _HEADING_REACHED else self.rotation.approach(error)
        return Velocity(v, omega)

    def _roll(self, velocity: Velocity, dt: float) -> None:
        self.velocity = velocity
        v, omega = velocity
        self.run = (self.run[0] + v * dt, self.run[1] + omega * dt)
        if self._distance is not None:
            self._distance -= v * dt
        if velocity == STANDSTILL:
            return
        self.wheel_pose = Pose(*along_arc(self.wheel_pose, velocity, dt))
        executed = Velocity(v * (1.0 - self._slip.v), omega * (1.0 - self._slip.omega))
        self.true_pose = Pose(*along_arc(self.true_pose, executed, dt))


def _reduced(value: float, step: float) -> float:
    return 0.0 if abs(value) <= step else value - math.copysign(step, value)
