"""The first leg: the motion that the base made, and what was seen on the way, tick by tick."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from visctrl.contracts import Views
from visctrl.geometry.trifocal.transfer import bearings
from visctrl.hal.types import Velocity
from visctrl.robots import Limits
from visctrl.robots.documents import StrictModel
from visctrl.robots.unicycle import exact_jacobians, step_exact

Array = NDArray[np.float64]
Ids = NDArray[np.int64]
NonNegative = Annotated[float, Field(ge=0.0)]


class MotionNoise(StrictModel):
    """How what a base executes scatters about what it is told, anew in every tick.

    v_m_s, omega_deg_s : standard deviations.
    gain : standard deviation of the odometer's unknown factor (wheel radius, slip).
    """

    v_m_s: NonNegative = 0.002
    omega_deg_s: NonNegative = 0.1
    gain: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0

    def covariance(self, velocity: Velocity) -> Array:
        """Return the covariance M (2, 2) of what is executed about ``velocity``.

        A robot that stands, stands.
        """
        if velocity.v == 0.0 and velocity.omega == 0.0:
            return np.zeros((2, 2))
        return np.diag([self.v_m_s**2, math.radians(self.omega_deg_s) ** 2])


class RampedVelocity:
    """Mean velocity of each tick, the base's acceleration ramp included.

    Parameters
    ----------
    limits : Limits or None
        Whose acceleration bounds shape the velocity; None for a base that follows at once.
    """

    def __init__(self, limits: Limits | None) -> None:
        self._limits = limits
        self._now = Velocity(0.0, 0.0)

    def during(self, sent: Velocity, dt: float) -> Velocity:
        """Return the mean velocity of ``dt`` seconds under ``sent``."""
        if self._limits is None or dt <= 0.0:
            self._now = sent
            return sent
        v_bound = self._limits.acceleration_m_s2
        omega_bound = self._limits.angular_acceleration_rad_s2
        v, v_end = _ramp(self._now.v, sent.v, v_bound, dt)
        omega, omega_end = _ramp(self._now.omega, sent.omega, omega_bound, dt)
        self._now = Velocity(v_end, omega_end)
        return Velocity(v, omega)


def _ramp(start: float, goal: float, bound: float, dt: float) -> tuple[float, float]:
    """Return mean and final value of a ramp from ``start`` to ``goal`` at the rate ``bound``."""
    change = goal - start
    ramp = min(abs(change) / bound, dt)
    end = goal if ramp < dt else start + (bound if change > 0.0 else -bound) * dt
    return (0.5 * (start + end) * ramp + end * (dt - ramp)) / dt, end


@dataclass(frozen=True)
class Leg:
    """What was seen on the first leg.

    theta1, theta3 : (N,) bearings in the initial and the target view (rad).
    sigma1, sigma3 : (N,) their standard deviations.
    motion : (F, 3) camera pose relative to C1 by dead reckoning (m, m, rad).
    turn_variance : (F,) variance of the heading in ``motion`` (rad²), never falling.
    theta2, sigma2 : (F, N) bearings on the way and their standard deviations; NaN where a
        feature was not seen.
    """

    theta1: Array
    theta3: Array
    sigma1: Array
    sigma3: Array
    motion: Array
    turn_variance: Array
    theta2: Array
    sigma2: Array


def seen(leg: Leg) -> Array:
    """Return 1 where a bearing (F, N) was measured and 0 elsewhere."""
    return np.isfinite(leg.theta2).astype(np.float64)


@dataclass
class _FixedBearings:
    """A feature's bearing in the initial and the target view, and their standard deviations."""

    theta1: float
    theta3: float
    sigma1: float
    sigma3: float


class InitialAverage:
    """Sharper initial view from further frames of the robot standing there."""

    def __init__(self) -> None:
        self._sum: dict[int, tuple[Array, int]] = {}

    def add(self, views: Views) -> None:
        """Take a frame from the initial pose into account."""
        for name, first, now in zip(views.ids.tolist(), views.initial, views.current, strict=True):
            total, count = self._sum.get(name, (first, 1))
            self._sum[name] = total + now, count + 1

    def applied(self, views: Views) -> Views:
        """Return views whose initial rays are the averages."""
        if not self._sum:
            return views
        known = [
            self._sum.get(name, (first, 1))
            for name, first in zip(views.ids.tolist(), views.initial, strict=True)
        ]
        initial = np.array([total for total, _ in known]).reshape(-1, 3)
        initial /= np.maximum(np.linalg.norm(initial, axis=1, keepdims=True), 1e-12)
        sigmas = views.bearing_sigmas().copy()
        sigmas[1] /= np.sqrt([count for _, count in known])
        return replace(views, initial=initial, sigmas=lambda: sigmas)


class ForwardLeg:
    """Frames of the first leg, from standstill at C1 onwards.

    Attributes
    ----------
    motion : (3,) array
        Dead-reckoned pose relative to C1 (m, m, rad).
    spread : (3, 3) array
        Its covariance.
    travelled : float
        Length of the way (m).
    frames : int
        Number of frames collected.
    """

    def __init__(self) -> None:
        self.motion = np.zeros(3)
        self.spread = np.zeros((3, 3))
        self.travelled = 0.0
        self._fixed: dict[int, _FixedBearings] = {}
        self._motions: list[Array] = []
        self._turn_variances: list[float] = []
        self._seen: list[tuple[Ids, Array, Array]] = []

    @property
    def frames(self) -> int:
        """Number of frames collected."""
        return len(self._seen)

    def move(self, velocity: Velocity, dt: float, offset: float, noise: Array) -> None:
        """Follow a velocity; ``noise`` (2, 2) is the covariance of what was executed about it."""
        F, G = exact_jacobians(self.motion, velocity.v, velocity.omega, dt, offset)
        self.motion = step_exact(self.motion, velocity.v, velocity.omega, dt, offset)
        self.spread = F @ self.spread @ F.T + G @ noise @ G.T
        self.travelled += abs(velocity.v) * dt

    def look(self, views: Views) -> None:
        """Add a frame taken at the present pose."""
        sigma = views.bearing_sigmas()
        columns = (bearings(views.initial), bearings(views.target), sigma[1], sigma[0])
        for name, *fixed in zip(views.ids.tolist(), *(c.tolist() for c in columns), strict=True):
            if name not in self._fixed:
                self._fixed[name] = _FixedBearings(*fixed)
        self._motions.append(self.motion)
        self._turn_variances.append(float(self.spread[2, 2]))
        self._seen.append((views.ids, bearings(views.current), sigma[2]))

    def collected(self, most: int) -> tuple[Ids, Leg]:
        """Return at most ``most`` features, spread all round, and what was seen of them."""
        names = np.array(sorted(self._fixed), dtype=np.int64)
        theta2, sigma2 = np.full((2, len(self._seen), len(names)), np.nan)
        for row, (ids, theta, sigma) in enumerate(self._seen):
            column = np.searchsorted(names, ids)
            theta2[row, column], sigma2[row, column] = theta, sigma
        fixed = [self._fixed[name] for name in names.tolist()]
        theta1 = np.array([f.theta1 for f in fixed])
        often = np.flatnonzero(2 * np.isfinite(theta2).sum(axis=0) > len(theta2))
        round_about = often[np.argsort(theta1[often])]
        if len(round_about) > most:
            round_about = round_about[np.arange(most) * len(round_about) // most]
        keep = np.sort(round_about)
        leg = Leg(
            theta1=theta1[keep],
            theta3=np.array([f.theta3 for f in fixed])[keep],
            sigma1=np.array([f.sigma1 for f in fixed])[keep],
            sigma3=np.array([f.sigma3 for f in fixed])[keep],
            motion=np.array(self._motions),
            turn_variance=np.array(self._turn_variances),
            theta2=theta2[:, keep],
            sigma2=sigma2[:, keep],
        )
        return names[keep], leg
