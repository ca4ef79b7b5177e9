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

from visctrl.hal.types import Velocity
from visctrl.robots.unicycle import arc, wrapped
from visctrl.schemes.epipolar.estimate import EpipolePair, Location
from visctrl.schemes.epipolar.position import Placed

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
    """A line in the target's frame by its unit normal (x, y), and its standard deviation (in D)."""

    x: float
    y: float
    sd: float


class _Covariance(NamedTuple):
    """Covariance of (x, y, φ, w = 1/D), p standing for φ: a symmetric matrix in plain floats."""

    xx: float = 0.0
    xy: float = 0.0
    xp: float = 0.0
    xw: float = 0.0
    yy: float = 0.0
    yp: float = 0.0
    yw: float = 0.0
    pp: float = 0.0
    pw: float = 0.0
    ww: float = 0.0

    def moved(self, by_phi: tuple[float, float], by_w: tuple[float, float]) -> _Covariance:
        """Return it after (x, y) moved by a way with these derivatives: F P Fᵀ."""
        (xx, xy, xp, xw, yy, yp, yw, pp, pw, ww), (a, b), (c, d) = self, by_phi, by_w
        new_xp, new_xw = xp + a * pp + c * pw, xw + a * pw + c * ww
        new_yp, new_yw = yp + b * pp + d * pw, yw + b * pw + d * ww
        return _Covariance(
            xx + a * (xp + new_xp) + c * (xw + new_xw),
            xy + b * xp + d * xw + a * new_yp + c * new_yw,
            new_xp,
            new_xw,
            yy + b * (yp + new_yp) + d * (yw + new_yw),
            new_yp,
            new_yw,
            pp,
            pw,
            ww,
        )

    def widened(self, xx: float, xy: float, yy: float, pp: float) -> _Covariance:
        """Return it with more noise of the position and of the heading."""
        return self._replace(xx=self.xx + xx, xy=self.xy + xy, yy=self.yy + yy, pp=self.pp + pp)

    def matrix(self) -> Array:
        """Return it as a matrix (4, 4)."""
        xx, xy, xp, xw, yy, yp, yw, pp, pw, ww = self
        return np.array([[xx, xy, xp, xw], [xy, yy, yp, yw], [xp, yp, pp, pw], [xw, yw, pw, ww]])


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
        self._x = (*self.reference, inverse_distance)
        self._P = _Covariance(
            xx=1e-8, yy=1e-8, pp=fixed.turn_sd**2 + 1e-8, ww=inverse_distance_sd**2
        )
        self._lines: dict[str, _Line] = {}
        #: Names of the lines that the last update measured.
        self._fresh: list[str] = []
        self._placed: Placed | None = None

    @property
    def pose(self) -> tuple[float, float, float]:
        """The present estimate of (x, y, φ)."""
        return self._x[:3]

    def predict(self, sent: Velocity, dt: float) -> None:
        """Move the state along the exact arc of ``sent`` during ``dt`` seconds."""
        x, y, phi, w = self._x
        moved = arc(phi, sent.v, sent.omega, dt, self._offset)
        self._x = (x + w * moved.dx, y + w * moved.dy, phi + moved.turn, w)
        # The way in units of D has the derivatives (−w dy, w dx) by φ and (dx, dy) by w.
        self._P = self._P.moved((-w * moved.dy, w * moved.dx), (moved.dx, moved.dy))
        way = (self._slip * w) ** 2 * (moved.dx**2 + moved.dy**2) + 1e-10
        turn = (self._turn_slip * sent.omega * dt) ** 2 + self._turn_drift**2
        xx, xy, yy = way, 0.0, way
        for name in self._fresh:
            line = self._lines[name]
            across_x, across_y = _FORGETTING * line.sd * line.x, _FORGETTING * line.sd * line.y
            xx, xy, yy = xx + across_x**2, xy + across_x * across_y, yy + across_y**2
        self._P = self._P.widened(xx, xy, yy, turn)

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

        See `visctrl.schemes.epipolar.position`. The lines of the last update remain; near the
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
        return Location(x, y, wrapped(phi), w, self._P.widened(xx, xy, yy, 0.0).matrix())

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
        (x, y, phi, w), P = self._x, self._P
        a, b, c = h
        # P h, and the variance of the innovation.
        p_x, p_y = a * P.xx + b * P.xy + c * P.xp, a * P.xy + b * P.yy + c * P.yp
        p_p, p_w = a * P.xp + b * P.yp + c * P.pp, a * P.xw + b * P.yw + c * P.pw
        known = 1.0 / (a * p_x + b * p_y + c * p_p + variance)
        gain = innovation * known
        self._x = (x + p_x * gain, y + p_y * gain, phi + p_p * gain, w + p_w * gain)
        k_x, k_y, k_p = p_x * known, p_y * known, p_p * known
        self._P = _Covariance(
            P.xx - k_x * p_x,
            P.xy - k_x * p_y,
            P.xp - k_x * p_p,
            P.xw - k_x * p_w,
            P.yy - k_y * p_y,
            P.yp - k_y * p_p,
            P.yw - k_y * p_w,
            P.pp - k_p * p_p,
            P.pw - k_p * p_w,
            P.ww - p_w * known * p_w,
        )
