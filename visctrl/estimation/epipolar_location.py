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

from hal.types import Velocity
from robots.unicycle import arc, wrapped
from visctrl.estimation.epipolar_position import Placed
from visctrl.estimation.epipole_estimates import EpipolePair, Location

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
    """A line in the target's frame by its unit normal (x, y), and its standard deviation (in D)."""

    x: float
    y: float
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
        phi1 = wrapped(-fixed.turn)
        #: World direction (rad) of the target seen from the reference view.
        self.psi1 = wrapped(phi1 - fixed.bearing_a)
        #: Pose of the reference view.
        self.reference = (math.sin(self.psi1), -math.cos(self.psi1), phi1)
        self._x = [*self.reference, inverse_distance]
        known = (1e-8, 1e-8, fixed.turn_sd**2 + 1e-8, inverse_distance_sd**2)
        self._P = [[v if i == j else 0.0 for j in range(4)] for i, v in enumerate(known)]
        self._lines: dict[str, _Line] = {}
        #: Names of the lines that the last update measured.
        self._fresh: list[str] = []
        self._placed: Placed | None = None

    @property
    def pose(self) -> tuple[float, float, float]:
        """The present estimate of (x, y, φ)."""
        return self._x[0], self._x[1], self._x[2]

    def predict(self, sent: Velocity, dt: float) -> None:
        """Move the state along the exact arc of ``sent`` during ``dt`` seconds."""
        x, y, phi, w = self._x
        moved = arc(phi, sent.v, sent.omega, dt, self._offset)
        self._x = [x + w * moved.dx, y + w * moved.dy, phi + moved.turn, w]
        # The motion in units of D has the derivatives (−w dy, w dx) by φ and (dx, dy) by w.
        a, b = -w * moved.dy, w * moved.dx
        P = self._P
        F_P = [
            [p + a * q + moved.dx * r for p, q, r in zip(P[0], P[2], P[3], strict=True)],
            [p + b * q + moved.dy * r for p, q, r in zip(P[1], P[2], P[3], strict=True)],
            P[2],
            P[3],
        ]
        P = [[p + a * r + moved.dx * s, q + b * r + moved.dy * s, r, s] for p, q, r, s in F_P]
        way = (self._slip * w) ** 2 * (moved.dx**2 + moved.dy**2) + 1e-10
        P[0][0] += way
        P[1][1] += way
        P[2][2] += (self._turn_slip * sent.omega * dt) ** 2 + self._turn_drift**2
        for name in self._fresh:
            line = self._lines[name]
            across_x, across_y = (_FORGETTING * line.sd * n for n in (line.x, line.y))
            P[0][0] += across_x * across_x
            P[0][1] += across_x * across_y
            P[1][0] += across_x * across_y
            P[1][1] += across_y * across_y
        self._P = P

    def update(self, target: EpipolePair, reference: EpipolePair, sd_limit: float) -> None:
        """Take in the pairs (current, target) and (reference, current).

        Epipoles less certain than ``sd_limit`` (rad) are left out.
        """
        self._fresh = []
        if target.turn_sd <= sd_limit:
            self._correct((0.0, 0.0, 1.0), wrapped(-target.turn - self._x[2]), target.turn_sd**2)
        if target.usable(sd_limit):
            self._on_line("target", -target.bearing_b, (0.0, 0.0), target.sd_b)
        if reference.usable(sd_limit):
            x, y, phi = self.reference
            self._on_line("reference", phi - reference.bearing_a, (x, y), reference.sd_a)

    def place(self, placed: Placed | None) -> None:
        """Take in where the features put the current view, None where they do not tell.

        See `visctrl.estimation.epipolar_position`. The lines of the last update remain; near the
        target they say less.
        """
        self._placed = placed
        if placed is None:
            return
        # Along the principal axes of the covariance, the one position is two numbers.
        xx, xy, yy = placed.variance
        angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
        s, c = math.sin(angle), math.cos(angle)
        largest = (xx + yy + math.hypot(xx - yy, 2.0 * xy)) / 2.0
        least = (xx * yy - xy * xy) / largest
        for axis_x, axis_y, variance in ((c, s, largest), (-s, c, least)):
            away = axis_x * (placed.x - self._x[0]) + axis_y * (placed.y - self._x[1])
            self._correct((axis_x, axis_y, 0.0), away, variance)

    @property
    def location(self) -> Location:
        """The present estimate; its covariance includes what the fixed views' noise may cost."""
        x, y, phi, w = self._x
        xx, xy, yy = self._fixed_noise()
        covariance = np.array(self._P)
        covariance[:2, :2] += ((xx, xy), (xy, yy))
        return Location(x, y, wrapped(phi), w, covariance)

    def _fixed_noise(self) -> tuple[float, float, float]:
        """Return the variance (of x, of both, of y) of the lines' meeting due to the fixed views.

        Half of a line's variance stems from the fixed view, and no averaging removes it.
        """
        if self._placed is not None:
            xx, xy, yy = self._placed.variance
            return xx / 2.0, xy / 2.0, yy / 2.0
        if len(self._lines) < 2:
            return 0.0, 0.0, 0.0
        a, b = self._lines.values()
        crossing = a.x * b.y - a.y * b.x
        if abs(crossing) < _MIN_CROSSING:
            return 0.0, 0.0, 0.0
        # How the meeting point moves with each line's own offset, times its deviation.
        x_a, y_a = b.y * a.sd / crossing, -b.x * a.sd / crossing
        x_b, y_b = -a.y * b.sd / crossing, a.x * b.sd / crossing
        return (
            (x_a * x_a + x_b * x_b) / 2.0,
            (x_a * y_a + x_b * y_b) / 2.0,
            (y_a * y_a + y_b * y_b) / 2.0,
        )

    def _on_line(
        self, name: str, direction: float, through: tuple[float, float], sd: float
    ) -> None:
        """Correct by a line of world ``direction`` (rad, counter-clockwise from y)."""
        c, s = math.cos(direction), math.sin(direction)
        x, y = self._x[0] - through[0], self._x[1] - through[1]
        line = _Line(c, s, math.hypot(sd * math.hypot(x, y), _LINE_FLOOR))
        self._lines[name] = line
        self._fresh.append(name)
        self._correct((c, s, 0.0), -(c * x + s * y), line.sd**2)

    def _correct(self, h: tuple[float, float, float], innovation: float, variance: float) -> None:
        """Correct by a measurement of h · (x, y, φ) that differs by the innovation."""
        a, b, c = h
        PH = [a * row[0] + b * row[1] + c * row[2] for row in self._P]
        scale = 1.0 / (a * PH[0] + b * PH[1] + c * PH[2] + variance)
        self._x = [x + p * scale * innovation for x, p in zip(self._x, PH, strict=True)]
        self._P = [
            [p - scale * left * right for p, right in zip(row, PH, strict=True)]
            for row, left in zip(self._P, PH, strict=True)
        ]
