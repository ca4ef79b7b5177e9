"""Where the robot is, from the lines through its epipoles: a small Kalman filter.

The epipoles of the pairs current–target and reference–current give two lines on which the
current view lies, one through the target and one through the reference view. Their common unit
is the distance D between these two views. The state (x, y, φ, 1/D) makes the prediction by the
velocities that were sent linear in position and scale.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.types import Velocity
from robots.unicycle import step_exact, wrap_angle
from visctrl.estimation.epipolar_position import Placed, place_view
from visctrl.estimation.epipole_estimates import EpipolePair, Location

Array = NDArray[np.float64]

#: Floor of a line's standard deviation, in units of D: what the linearisation itself costs.
_LINE_FLOOR = 2e-4
#: Position noise per tick, across each line just measured, as a share of the line's own: the
#: estimate follows the newest lines within a few ticks. The noise of the fixed views is the same
#: in all of them: a longer memory gains nothing, and at the target the newest are unbiased.
_FORGETTING = 0.1
#: Share of a turn, and drift a tick (rad), by which a turn seen through a lens of unknown focal
#: length may differ from the one that was sent: the heading follows the images.
_LOOSE_TURN = (0.7, 5e-3)
#: Sine of the angle between the two lines below which they do not meet in a point.
_MIN_CROSSING = 0.02


class _Line(NamedTuple):
    """A line in the target's frame by its unit normal, and its standard deviation (in D)."""

    normal: Array
    sd: float


class LocationFilter:
    """Kalman filter on (x, y, φ, 1/D).

    Parameters
    ----------
    fixed : EpipolePair
        Reference and target view: the constants of the run.
    inverse_distance, inverse_distance_sd : float
        What is known beforehand of 1/D (1/m).
    camera_forward_m : float
        The camera ahead of the axle (m).
    slip : float
        Standard deviation of the executed motion as a fraction of the commanded one.
    metric : bool
        Whether the camera is calibrated, so that its turns are those of the wheels.
    """

    def __init__(
        self,
        fixed: EpipolePair,
        inverse_distance: float,
        inverse_distance_sd: float,
        camera_forward_m: float,
        slip: float,
        metric: bool = True,
    ) -> None:
        self._offset = camera_forward_m
        self._slip = slip
        self._turn_slip, self._turn_drift = (slip, 1e-4) if metric else _LOOSE_TURN
        self._phi1 = float(wrap_angle(-fixed.turn))
        #: World direction (rad) of the target seen from the reference view.
        self.psi1 = float(wrap_angle(self._phi1 - fixed.bearing_a))
        self._origin = np.array([math.sin(self.psi1), -math.cos(self.psi1)])
        self._x = np.array([*self._origin, self._phi1, inverse_distance])
        self._P = np.diag([1e-8, 1e-8, fixed.turn_sd**2 + 1e-8, inverse_distance_sd**2])
        self._lines: dict[str, _Line] = {}
        #: Names of the lines that the last update measured.
        self._fresh: list[str] = []
        self._placed: Placed | None = None

    def predict(self, sent: Velocity, dt: float) -> None:
        """Move the state along the exact arc of ``sent`` during ``dt`` seconds."""
        phi, w = float(self._x[2]), float(self._x[3])
        moved = step_exact([0.0, 0.0, phi], sent.v, sent.omega, dt, self._offset)
        F = np.eye(4)
        F[:2, 3] = moved[:2]
        F[0, 2], F[1, 2] = -w * moved[1], w * moved[0]
        self._x[:2] += w * moved[:2]
        self._x[2] = float(moved[2])
        way = (self._slip * w) ** 2 * float(moved[:2] @ moved[:2])
        turn = (self._turn_slip * sent.omega * dt) ** 2 + self._turn_drift**2
        self._P = F @ self._P @ F.T + np.diag([way + 1e-10, way + 1e-10, turn, 0.0])
        for name in self._fresh:
            across = _FORGETTING * self._lines[name].sd * self._lines[name].normal
            self._P[:2, :2] += np.outer(across, across)

    def update(self, target: EpipolePair, reference: EpipolePair, sd_limit: float) -> None:
        """Take in the pairs (current, target) and (reference, current).

        Epipoles less certain than ``sd_limit`` (rad) are left out.
        """
        self._fresh = []
        if target.turn_sd <= sd_limit:
            innovation = float(wrap_angle(-target.turn - self._x[2]))
            self._correct(np.array([0.0, 0.0, 1.0, 0.0]), innovation, target.turn_sd)
        if target.usable(sd_limit):
            self._on_line("target", -target.bearing_b, np.zeros(2), target.sd_b)
        if reference.usable(sd_limit):
            direction = self._phi1 - reference.bearing_a
            self._on_line("reference", direction, self._origin, reference.sd_a)

    def place(self, rays: tuple[Array, Array, Array], sigma: float) -> None:
        """Take in where the features (target, reference, current) put the current view.

        See `place_view`. The lines of the last update remain; near the target they say less.
        """
        reference = (float(self._origin[0]), float(self._origin[1]), self._phi1)
        here = (float(self._x[0]), float(self._x[1]), float(self._x[2]))
        self._placed = place_view(rays, reference, here, sigma)
        if self._placed is None:
            return
        variances, axes = np.linalg.eigh(self._placed.covariance)
        for variance, axis in zip(variances, axes.T, strict=True):
            innovation = float(axis @ (self._placed.position - self._x[:2]))
            self._correct(np.array([*axis, 0.0, 0.0]), innovation, math.sqrt(variance))

    @property
    def location(self) -> Location:
        """The present estimate; its covariance includes what the fixed views' noise may cost."""
        x, y, phi, w = (float(value) for value in self._x)
        covariance = self._P.copy()
        covariance[:2, :2] += self._fixed_noise()
        return Location(x, y, float(wrap_angle(phi)), w, covariance)

    def _fixed_noise(self) -> Array:
        """Return the covariance (2, 2) of the lines' meeting point due to the fixed views.

        Half of a line's variance stems from the fixed view, and no averaging removes it.
        """
        if self._placed is not None:
            return np.asarray(self._placed.covariance / 2.0)
        if len(self._lines) < 2:
            return np.zeros((2, 2))
        normals = np.stack([line.normal for line in self._lines.values()])
        crossing = float(np.linalg.det(normals))
        if abs(crossing) < _MIN_CROSSING:
            return np.zeros((2, 2))
        spread = np.linalg.inv(normals) * [line.sd for line in self._lines.values()]
        return np.asarray(spread @ spread.T / 2.0)

    def _on_line(self, name: str, direction: float, through: Array, sd: float) -> None:
        """Correct by a line of world ``direction`` (rad, counter-clockwise from y)."""
        normal = np.array([math.cos(direction), math.sin(direction)])
        away = self._x[:2] - through
        line = _Line(normal, math.hypot(sd * float(np.linalg.norm(away)), _LINE_FLOOR))
        self._lines[name] = line
        self._fresh.append(name)
        self._correct(np.array([*normal, 0.0, 0.0]), -float(normal @ away), line.sd)

    def _correct(self, H: Array, innovation: float, sd: float) -> None:
        PH = self._P @ H
        gain = PH / (float(H @ PH) + sd**2)
        self._x = self._x + gain * innovation
        A = np.eye(4) - np.outer(gain, H)
        self._P = A @ self._P @ A.T + sd**2 * np.outer(gain, gain)
