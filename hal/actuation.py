"""From a wanted velocity to what a base executes.

`Limiter` bounds, ramps and rounds what a controller wants, once, for every backend. `Actuation`
is the other side, a base's own: units, delay and acceleration ramp of a simulated one, as an
ARCOS base has them.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Annotated

import numpy as np
from pydantic import Field

from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.robots import Limits
from visctrl.robots.documents import StrictModel

_MM = 1000.0
#: Half of the units that an ARCOS base takes: 1 mm/s (VEL) and 1 deg/s (RVEL).
_V_HALF, _OMEGA_HALF = 0.5e-3, math.radians(0.5)
#: Times this close (s) are the same instant.
_SAME_INSTANT_S = 1e-9

Fraction = Annotated[float, Field(gt=-1.0, lt=1.0)]


class WheelErrors(StrictModel):
    """True over nominal values of a base's wheels; its odometry does not notice them.

    left, right : of the wheels' radii. track : of the distance between them.
    """

    left: Annotated[float, Field(gt=0.5, lt=2.0)] = 1.0
    right: Annotated[float, Field(gt=0.5, lt=2.0)] = 1.0
    track: Annotated[float, Field(gt=0.5, lt=2.0)] = 1.0


class Scatter(StrictModel):
    """How the mean velocity executed in a tick scatters about what was commanded.

    v_m_s, omega_deg_s : standard deviations, drawn anew in every tick of a moving robot.
    """

    v_m_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    omega_deg_s: Annotated[float, Field(ge=0.0, le=90.0)] = 0.0

    def drawer(self, rng: np.random.Generator) -> Callable[[], Velocity]:
        """Return what draws by how much a tick's velocity differs from the commanded one."""
        if self == Scatter():
            return lambda: STANDSTILL
        v_sd, omega_sd = self.v_m_s, math.radians(self.omega_deg_s)

        def draw() -> Velocity:
            v, omega = rng.normal(size=2).tolist()
            return Velocity(v * v_sd, omega * omega_sd)

        return draw


class ActuationOptions(StrictModel):
    """How far a base is from executing its commands at once and exactly.

    quantise : commands go out in whole mm/s and deg/s, the units of the ARCOS protocol.
    delay_s : time from a command to its effect.
    slip_v, slip_omega : fractions of the set-point that the robot fails to execute; its
        odometry does not notice. The robot model applies them, not `Actuation`.
    wheels : what is wrong with the wheels; applied like slip.
    """

    quantise: bool = True
    delay_s: Annotated[float, Field(ge=0.0)] = 0.0
    slip_v: Fraction = 0.0
    slip_omega: Fraction = 0.0
    wheels: WheelErrors = WheelErrors()

    def executed(self, set_point: Velocity, track_m: float) -> Velocity:
        """Return what wheels and slip make of a set-point; ``track_m`` (m) is the nominal track."""
        if self.wheels != WheelErrors():
            mean, half = self._mean_and_half
            set_point = Velocity(
                mean * set_point.v + half * track_m / 2.0 * set_point.omega,
                (mean * set_point.omega + 2.0 * half / track_m * set_point.v) / self.wheels.track,
            )
        if self.slip_v == 0.0 and self.slip_omega == 0.0:
            return set_point
        return Velocity(
            (1.0 - self.slip_v) * set_point.v, (1.0 - self.slip_omega) * set_point.omega
        )

    def noticed(self, executed: Velocity, track_m: float) -> Velocity:
        """Return what odometry makes of a velocity: the inverse of `executed`."""
        v, omega = executed.v / (1.0 - self.slip_v), executed.omega / (1.0 - self.slip_omega)
        if self.wheels == WheelErrors():
            return Velocity(v, omega)
        mean, half = self._mean_and_half
        omega *= self.wheels.track
        square = mean**2 - half**2
        return Velocity(
            (mean * v - half * track_m / 2.0 * omega) / square,
            (mean * omega - 2.0 * half / track_m * v) / square,
        )

    @property
    def _mean_and_half(self) -> tuple[float, float]:
        """Mean, and half of the difference, of the wheels' radii over the nominal one."""
        left, right = self.wheels.left, self.wheels.right
        return (right + left) / 2.0, (right - left) / 2.0


class Limiter:
    """Bounds, ramps and rounds velocities, so that the base executes what it is sent.

    Bounds scale v and ω alike, which keeps the path's curvature. Rounding carries its remainder
    to the next command: on average the base turns by what was wanted, however small against
    1 deg/s.

    Parameters
    ----------
    limits : Limits or None
        Bounds of speed and acceleration; None for an ideal base, which takes any value.
    whole_units : bool
        Whether the base takes whole mm/s and deg/s only (see `Base.whole_units`).
    """

    def __init__(self, limits: Limits | None, *, whole_units: bool) -> None:
        self._limits = limits
        self._whole_units = whole_units
        self._ramped = self._given = self._left = STANDSTILL

    def limit(self, wanted: Velocity, dt: float) -> Velocity:
        """Return what to send for ``wanted`` after ``dt`` seconds of the last command."""
        limits, ramped = self._limits, bounded(wanted, self._limits)
        if limits is not None:
            ramped = Velocity(
                towards(self._ramped.v, ramped.v, limits.acceleration_m_s2 * dt),
                towards(self._ramped.omega, ramped.omega, limits.angular_acceleration_rad_s2 * dt),
            )
        if wanted == STANDSTILL:
            self._left = STANDSTILL
        self._ramped = ramped
        self._given = self._rounded(ramped) if self._whole_units else ramped
        return self._given

    def was_sent(self, sent: Velocity) -> None:
        """Note what the base was told, which is something else where it was stopped."""
        if sent != self._given:
            self._ramped = self._given = sent
            self._left = STANDSTILL

    def stop(self) -> None:
        """Start from standstill; nothing is carried on from before."""
        self._ramped = self._given = self._left = STANDSTILL

    def _rounded(self, ramped: Velocity) -> Velocity:
        due = Velocity(ramped.v + self._left.v, ramped.omega + self._left.omega)
        sent = quantised(due, self._limits)
        # More than half a unit is left only where a bound forbids it: that is not made up for.
        self._left = Velocity(
            max(-_V_HALF, min(_V_HALF, due.v - sent.v)),
            max(-_OMEGA_HALF, min(_OMEGA_HALF, due.omega - sent.omega)),
        )
        return sent


class Actuation:
    """Turns commands into the velocity set-point of the wheels.

    Parameters
    ----------
    limits : Limits or None
        Bounds of speed and acceleration; None for an ideal base that has none.
    options : ActuationOptions
        Quantisation and delay.
    """

    def __init__(self, limits: Limits | None, options: ActuationOptions) -> None:
        self._limits = limits
        self._acceleration = (
            (limits.acceleration_m_s2, limits.angular_acceleration_rad_s2) if limits else None
        )
        self._options = options
        self._pending: deque[tuple[float, Velocity]] = deque()
        self._wanted = STANDSTILL
        self._set_point = STANDSTILL

    def request(self, t: float, velocity: Velocity) -> Velocity:
        """Take a command at time ``t`` (s) and return what is really sent.

        v and ω are scaled down together, so that a bound leaves the path's curvature as it is.
        The command acts from ``t + delay_s`` on.

        Raises
        ------
        ValueError
            The velocity is not finite.
        """
        if not velocity.finite:
            raise ValueError(f"velocity command is not finite: {velocity}")
        sent = bounded(velocity, self._limits)
        if self._options.quantise:
            sent = quantised(sent, self._limits)
        self._pending.append((t + self._options.delay_s, sent))
        return sent

    def velocity_at(self, t: float, dt: float) -> Velocity:
        """Advance the ramp over the step from ``t`` to ``t + dt`` and return its end value.

        Commands that act by ``t`` count. Each of v and ω moves towards the newest one at its
        own acceleration bound, as the base's firmware does; with ramps, delays or both, steps
        should be short against the command period.
        """
        while self._pending and self._pending[0][0] <= t + _SAME_INSTANT_S:
            self._wanted = self._pending.popleft()[1]
        wanted, now = self._wanted, self._set_point
        if self._acceleration is None or now == wanted:
            self._set_point = wanted
        else:
            dv, dw = self._acceleration
            self._set_point = Velocity(
                towards(now.v, wanted.v, dv * dt), towards(now.omega, wanted.omega, dw * dt)
            )
        return self._set_point

    @property
    def whole_units(self) -> bool:
        """Whether commands are rounded to whole mm/s and deg/s."""
        return self._options.quantise

    @property
    def moving(self) -> bool:
        """Whether the set-point is not zero."""
        return self._set_point != STANDSTILL

    @property
    def steady(self) -> bool:
        """Whether the set-point will stay as it is until the next command."""
        return not self._pending and self._set_point == self._wanted

    def halt(self) -> None:
        """Forget every command and stand still at once (the world is being put back)."""
        self._pending.clear()
        self._wanted = self._set_point = STANDSTILL


def bounded(velocity: Velocity, limits: Limits | None) -> Velocity:
    """Return ``velocity`` within its bounds, both components scaled alike (curvature stays)."""
    if limits is None:
        return velocity
    excess = max(1.0, limits.ratio(*velocity))
    return Velocity(velocity.v / excess, velocity.omega / excess)


def quantised(velocity: Velocity, limits: Limits | None) -> Velocity:
    """Return ``velocity`` in whole mm/s and deg/s, the nearest that keep its bounds."""
    top_mm = limits.v_m_s * _MM if limits else math.inf
    top_deg = limits.omega_deg_s if limits else math.inf
    v_mm = _whole(velocity.v * _MM, top_mm)
    omega_deg = _whole(math.degrees(velocity.omega), top_deg)
    nearest = Velocity(v_mm / _MM, math.radians(omega_deg))
    if limits is None or limits.ratio(*nearest) <= 1.0 + 1e-9:
        return nearest
    # Both rounded up, a wheel would be too fast.
    return Velocity(
        math.trunc(velocity.v * _MM) / _MM, math.radians(math.trunc(math.degrees(velocity.omega)))
    )


def _whole(value: float, bound: float) -> int:
    """Return the integer nearest to ``value`` that does not exceed ``bound`` in magnitude."""
    nearest = math.floor(abs(value) + 0.5)
    if nearest > bound + 1e-9:
        nearest -= 1
    return int(math.copysign(nearest, value))


def towards(value: float, goal: float, step: float) -> float:
    """Return ``value`` moved to ``goal`` by at most ``step``."""
    return goal if abs(goal - value) <= step else value + math.copysign(step, goal - value)
