"""The bases of many robots: what the mock, the guard and the controllers make of velocities.

`hal.actuation`, the mock's motion, `CommandShaper`, `Guard` and `DeadReckoning` in arrays, for
bases without delay, slip and scatter. Without limits each of them passes everything on.
"""

from __future__ import annotations

import numpy as np

from visctrl.hal.mock.backend import MockOptions
from visctrl.montecarlo.robots import Array, Mask, Robots, Velocities
from visctrl.robots import Limits
from visctrl.runtime.plan import Plan
from visctrl.schemes.command_shaping import OMEGA_STEP, V_STEP

#: Longest step of a motion while it is ramping, and one that is none (s): as the mock has it.
_STEP_S, _INSTANT_S = 0.01, 1e-12
_MM = 1000.0


class Bases(Robots):
    """R bases on the plane, with their clocks.

    Parameters
    ----------
    starts : (R, 3) array
        Poses of the cameras, which are above the axles.
    plan : Plan
        Of the mock; its start is not used.

    Attributes
    ----------
    pose : (R, 3) array
        True pose (m, rad), the heading not wrapped.
    now : (R,) array
        Time since the start (s).
    way : (R,) array
        Length of the path between the moments at which `look` was called (m).
    """

    def __init__(self, starts: Array, plan: Plan) -> None:
        options = plan.backend_options
        assert isinstance(options, MockOptions)
        self._limits = plan.limits
        self._quantise = options.actuation.quantise and not options.ideal
        count = len(starts)
        self.pose, self.now, self.way = starts, np.zeros(count), np.zeros(count)
        self._position = starts[:, 0], starts[:, 1]
        self._wanted = self.set_point = Velocities.none(count)

    def command(self, velocities: Velocities) -> Velocities:
        """Set velocities; return them after limits and quantisation."""
        sent = bounded(velocities, self._limits)[0]
        if self._quantise:
            limits = self._limits
            top = (np.inf, np.inf) if limits is None else (limits.v_m_s * _MM, limits.omega_deg_s)
            sent = Velocities(
                _whole(sent.v * _MM, top[0]) / _MM,
                np.radians(_whole(np.degrees(sent.omega), top[1])),
            )
        self._wanted = sent
        return sent

    def stop(self) -> None:
        """Tell all to stand."""
        self.command(Velocities.none(len(self.now)))

    def sleep_until(self, deadline: Array) -> None:
        """Let the world move on to a time (R,) of its own for each (s)."""
        left = deadline - self.now
        self.now = deadline
        if self._limits is None:
            self.set_point = self._wanted
            self.pose = _along_arcs(self.pose, self.set_point, left)
            return
        while (moving := left > _INSTANT_S).any():
            steady = (self.set_point.v == self._wanted.v) & (
                self.set_point.omega == self._wanted.omega
            )
            step = np.where(steady, left, np.minimum(left, _STEP_S)) * moving
            self.set_point = ramped(self.set_point, self._wanted, self._limits, step)
            self.pose = _along_arcs(self.pose, self.set_point, step)
            left = left - step

    def look(self) -> None:
        """Take note of the positions: `way` grows."""
        x, y, _ = self.pose.T
        self.way = self.way + np.hypot(x - self._position[0], y - self._position[1])
        self._position = x, y


class Shapers(Robots):
    """R command shapers: see `visctrl.schemes.command_shaping.CommandShaper`."""

    def __init__(self, count: int, limits: Limits | None, *, whole_units: bool) -> None:
        self._limits, self._whole_units = limits, whole_units
        self._last, self._carry = Velocities.none(count), Velocities.none(count)

    def command(self, wanted: Velocities, dt: Array) -> Velocities:
        """Return what to send for ``wanted`` after ``dt`` (R,) seconds of the last command."""
        if self._limits is None:
            return wanted
        self._last = ramped(self._last, bounded(wanted, self._limits)[0], self._limits, dt)
        if not self._whole_units:
            return self._last
        sent, carry = [], []
        parts = zip(self._last, self._carry, (V_STEP, OMEGA_STEP), strict=True)
        for wish, rest, unit in parts:
            due = wish / unit + rest
            whole = np.floor(due + 0.5)
            carry.append(due - whole)
            sent.append(whole * unit)
        self._carry = Velocities(*carry)
        return Velocities(*sent)

    def stop(self, which: Mask) -> None:
        """Let some stand; nothing is carried on from before."""
        self._last, self._carry = self._last.only(~which), self._carry.only(~which)


class Guards(Robots):
    """What safety makes of commands: see `visctrl.runtime.safety.Guard`."""

    def __init__(self, count: int, limits: Limits | None) -> None:
        self._limits, self._sent = limits, Velocities.none(count)

    def permit(self, wanted: Velocities, dt: Array) -> Velocities:
        """Return what may be sent after ``dt`` (R,) seconds of the last command."""
        if self._limits is None:
            return wanted
        return ramped(self._sent, bounded(wanted, self._limits)[0], self._limits, dt)

    def was_sent(self, sent: Velocities) -> None:
        """Note what the bases were told."""
        self._sent = sent


class Reckonings(Robots):
    """R dead reckonings, with ramps: see `visctrl.schemes.path_scale.DeadReckoning`."""

    def __init__(self, count: int, limits: Limits | None) -> None:
        self._limits, self._velocity = limits, Velocities.none(count)

    def motion(self, sent: Velocities, dt: Array) -> Array:
        """Return the motions (R, 3) in ``dt`` (R,) seconds under ``sent``, in the own frames."""
        pose = np.zeros((len(dt), 3))
        if self._limits is None:
            return _along_arcs(pose, sent, dt)
        steady = (self._velocity.v == sent.v) & (self._velocity.omega == sent.omega)
        steps = np.where(steady, 1.0, np.maximum(1.0, np.ceil(dt / _STEP_S)))
        step = dt / steps
        for k in range(int(steps.max())):
            now = step * (k < steps)
            self._velocity = ramped(self._velocity, sent, self._limits, now)
            pose = _along_arcs(pose, self._velocity, now)
        return pose


def bounded(velocities: Velocities, limits: Limits | None) -> tuple[Velocities, Array | float]:
    """Return velocities within their bounds, and the factor ≤ 1 that brought them there."""
    if limits is None:
        return velocities, 1.0
    excess = np.maximum(np.abs(velocities.v) / limits.v_m_s, 1.0)
    excess = np.maximum(excess, np.abs(velocities.omega) / limits.omega_rad_s)
    return Velocities(velocities.v / excess, velocities.omega / excess), 1.0 / excess


def ramped(velocities: Velocities, goals: Velocities, limits: Limits, dt: Array) -> Velocities:
    """Return velocities moved to their goals as far as the accelerations allow in ``dt`` (R,)."""
    return Velocities(
        _towards(velocities.v, goals.v, limits.acceleration_m_s2 * dt),
        _towards(velocities.omega, goals.omega, limits.angular_acceleration_rad_s2 * dt),
    )


def _towards(value: Array, goal: Array, step: Array) -> Array:
    left = goal - value
    return np.where(np.abs(left) <= step, goal, value + np.copysign(step, left))


def _whole(value: Array, bound: float) -> Array:
    """Return the integers nearest to values that do not exceed ``bound`` in magnitude."""
    nearest = np.floor(np.abs(value) + 0.5)
    return np.copysign(np.where(nearest > bound + 1e-9, nearest - 1.0, nearest), value)


def _along_arcs(pose: Array, velocities: Velocities, dt: Array) -> Array:
    """Return poses (R, 3) moved along exact arcs: see `visctrl.robots.unicycle.along_arc`."""
    x, y, phi = pose.T
    half = velocities.omega * dt / 2.0
    turning = np.abs(half) > 1e-9
    safe = np.where(turning, half, 1.0)
    chord = velocities.v * dt * np.where(turning, np.sin(safe) / safe, 1.0)
    middle = phi + half
    return np.stack(
        [x - chord * np.sin(middle), y + chord * np.cos(middle), phi + 2.0 * half], axis=1
    )
