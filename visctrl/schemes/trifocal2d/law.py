"""Controller ``trifocal2d``: pseudo-inverse control on the twelve-element trifocal tensor.

The scheme that came before the one on the 1D tensor, as the source describes it: every element
follows a sinusoidal reference, and the velocity is the least-squares solution of a rectangular
system, an inversion that is not exact. Two inputs cannot bring ten elements to arbitrary values,
so where the references ask for what a unicycle cannot do, the robot stops in a local minimum.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from visctrl.contracts import Context, Controller, Decision, Estimate, Health, Signal
from visctrl.geometry.trifocal.tensor2d import T212, T232, rates_2d, tensor_2d
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.schemes.sliding_mode import CosineDescent
from visctrl.schemes.termination import Arrival, ArrivalOptions, Verdict
from visctrl.schemes.trifocal2d.estimator import Tensor2dEstimate

Array = NDArray[np.float64]

#: Cruising speed of a base without limits (m/s), and its share of the limits of one that has.
_IDEAL_CRUISE, _CRUISE_SHARE = 0.4, 0.7
#: Turning rate of a base without limits (rad/s).
_IDEAL_TURN = 0.3
#: Shortest duration of a turn (s).
_SHORTEST_TURN_S = 2.0
#: Step of the references' numerical rate (s).
_H_S = 1e-3
#: The elements that stand for the initial view do not move.
_MOVING = np.array([element for element in range(12) if element not in (T212, T232)])

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]


class Trifocal2dOptions(ArrivalOptions):
    """Options of `Trifocal2d`, besides `ArrivalOptions` (it never retreats).

    references : ``sequence`` lets the elements follow what they are on a turn to the target, a
        straight way and a turn to the target's heading, each timed by a cosine; ``direct`` takes
        every element by a cosine of its own to its final value, which no robot can follow.
    tau_s : duration of the way; from the distance and the speed limit if left out.
    turn_s : duration of either turn; from the angle and the limit if left out.
    gain : rate at which errors fall (1/s).
    damping : of the pseudo-inverse, in units of the elements.
    advance_m, advance_m_s : the straight leg that scales the tensor.
    settle_s : the run ends this long after the references, if not by arrival before.
    """

    references: Literal["sequence", "direct"] = "sequence"
    tau_s: Positive | None = None
    turn_s: Positive | None = None
    gain: Positive = 1.0
    damping: NotNegative = 1e-3
    advance_m: NotNegative = 0.2
    advance_m_s: Positive = 0.2
    settle_s: NotNegative = 10.0


class Trifocal2d(Controller[Trifocal2dOptions, Tensor2dEstimate]):
    """Phases: advance (straight), tracking, settling."""

    Options: ClassVar[type[Trifocal2dOptions]] = Trifocal2dOptions
    accepts: ClassVar[type[Estimate]] = Tensor2dEstimate
    signals: ClassVar[tuple[Signal, ...]] = (
        Signal("error", "1"),
        Signal("progress", "s"),
        Signal("determinant", "1"),
    )

    def __init__(self, options: Trifocal2dOptions, context: Context) -> None:
        super().__init__(options, context)
        self._arrival = Arrival(options)
        self._references: _References | None = None
        self._advanced = 0.0
        self._progress = 0.0
        self._values: dict[str, float] = {}

    def update(self, estimate: Tensor2dEstimate, sent: Velocity, dt: float) -> Decision:
        """Return the velocity for an estimate; what was ``sent`` has acted for ``dt`` (s)."""
        self._values = {}
        if estimate.health is not Health.OK:
            return Decision(STANDSTILL, "tracking" if self._references else "advance")
        if self._references is None:
            self._advanced += sent.v * dt
            if self._advanced < self.options.advance_m - 1e-9:
                return Decision(Velocity(self.options.advance_m_s, 0.0), "advance")
            self._references = self._begin(estimate)
        return self._track(estimate, self._references, sent, dt)

    def values(self) -> Mapping[str, float]:
        """Return how far the elements are from their references, and the clock."""
        return self._values

    def _track(
        self, estimate: Tensor2dEstimate, references: _References, sent: Velocity, dt: float
    ) -> Decision:
        wanted = self._inverted(estimate, references)
        # Where the robot is held back by its limits, the references wait for it.
        self._progress += dt * self.context.slowdown(wanted)
        over = self._progress - references.duration
        if over < 0.0:
            return Decision(wanted, "tracking")
        right, forward = estimate.target * estimate.scale_m
        verdict = self._arrival.judge((right, forward), estimate.heading, sent, dt)
        if verdict is Verdict.UNDER_WAY and over < self.options.settle_s:
            return Decision(wanted, "settling")
        return Decision(STANDSTILL, "settling", finished=True)

    def _inverted(self, estimate: Tensor2dEstimate, references: _References) -> Velocity:
        """Return (JᵀJ + damping²)⁻¹ Jᵀ (T_d' − gain (T − T_d)), the damped pseudo-inverse."""
        scale = estimate.scale_m
        # The target's direction from the initial view is taken as it is measured now: near the
        # goal it is not determined, and must not look like an error.
        fixed = estimate.elements[[T212, T232]]
        t = self._progress
        wanted = references.at(t, fixed)
        rate = (references.at(t + _H_S, fixed) - references.at(t, fixed)) / _H_S
        error = estimate.elements - wanted
        J = rates_2d(estimate.elements, estimate.phi_1, scale)[_MOVING]
        # Metres and radians are weighed as the elements weigh them.
        J[:, 0] *= scale
        normal = J.T @ J
        drive = (rate - self.options.gain * error)[_MOVING]
        inverse = normal + self.options.damping**2 * np.eye(2)
        v, omega = np.linalg.solve(inverse, J.T @ drive)
        self._values = {
            "error": float(np.linalg.norm(error[_MOVING])),
            "progress": t,
            "determinant": float(np.linalg.det(normal)),
        }
        return Velocity(float(v) * scale, float(omega))

    def _begin(self, estimate: Tensor2dEstimate) -> _References:
        """Return the references from here to the target."""
        right, forward = estimate.target
        distance = math.hypot(right, forward)
        bearing = math.atan2(right, forward)
        limits, cruise, turning = self.context.limits, _IDEAL_CRUISE, _IDEAL_TURN
        if limits is not None:
            cruise, turning = _CRUISE_SHARE * limits.v_m_s, _CRUISE_SHARE * limits.omega_rad_s
        tau = self.options.tau_s or math.pi / 2.0 * distance * estimate.scale_m / cruise
        facing = math.remainder(estimate.heading - bearing, math.tau)

        def turn(angle: float) -> float:
            least = max(_SHORTEST_TURN_S, math.pi / 2.0 * abs(angle) / turning)
            return self.options.turn_s or least

        times = (turn(bearing), tau, turn(facing))
        if self.options.references == "direct":
            return _Direct(estimate.elements, estimate.phi_1, sum(times))
        return _Sequence(estimate.phi_1, distance, (bearing, facing), times)


class _References:
    """What the elements shall be ``t`` seconds after the references have begun."""

    duration: float

    def at(self, t: float, fixed: Array) -> Array:
        """Return the elements (12,); ``fixed`` (2,) are T212 and T232."""
        raise NotImplementedError


class _Direct(_References):
    """Every element by a cosine from where it is to where it is at the target."""

    def __init__(self, elements: Array, phi_1: float, duration: float) -> None:
        self.duration = duration
        self._start, self._phi_1 = elements, phi_1
        self._descent = CosineDescent(duration)

    def at(self, t: float, fixed: Array) -> Array:
        goal = tensor_2d(self._phi_1, -fixed, 0.0, np.zeros(2))
        start = self._start.copy()
        start[[T212, T232]] = fixed
        level, _ = self._descent.at(t)
        return np.asarray(goal + (start - goal) * level)


class _Sequence(_References):
    """The elements on a turn to the target, a straight way and a turn to its heading.

    Parameters
    ----------
    phi_1 : float
        Heading of the initial view (rad).
    distance : float
        To the target, in units of |t_1|.
    angles : (bearing, facing)
        The target's bearing, and the heading of a robot that looks at it (rad).
    times : (3,) floats
        Durations of turn, way and turn (s).
    """

    def __init__(
        self,
        phi_1: float,
        distance: float,
        angles: tuple[float, float],
        times: tuple[float, float, float],
    ) -> None:
        self.duration = sum(times)
        self._phi_1, self._distance = phi_1, distance
        self._bearing, self._facing = angles
        self._begins = (0.0, times[0], times[0] + times[1])
        self._descents = tuple(CosineDescent(time) for time in times)

    def at(self, t: float, fixed: Array) -> Array:
        turn, way, last = (
            descent.at(t - begin)[0]
            for descent, begin in zip(self._descents, self._begins, strict=True)
        )
        bearing, ahead = self._bearing * turn, self._distance * way
        target = ahead * np.array([math.sin(bearing), math.cos(bearing)])
        heading = self._facing * last + bearing
        return tensor_2d(self._phi_1, -fixed, heading, target)
