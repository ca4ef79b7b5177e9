"""The super-twisting algorithm by an implicit step: second-order sliding without chatter.

    s' = r + d,    r = −λ √|s| sgn s + w,    w' = −W sgn s

drives s and s' to zero in finite time against any disturbance d whose rate stays below W
(A. Levant, *Sliding order and sliding accuracy in sliding mode control*, 1993). Explicit Euler
steps of it chatter. In an implicit step the root and the sign are those of s at its *end*, so that
it ends at s = 0 instead of beyond (B. Brogliato and others, *The implicit discretization of the
super-twisting sliding-mode control algorithm*, 2020). Here the step reaches as far ahead as the
loop takes to answer, not only to the next tick: a robot that answers late would overshoot a
surface that it is told to reach at once.
"""

from __future__ import annotations

import math


class SuperTwisting:
    """One output's controller.

    Parameters
    ----------
    gain : float
        λ (units of √s per time).
    integral_gain : float
        W (units of s per time²).
    most : float
        Bound of |w|: a disturbance that is taken for real (units of s per time).
    horizon : float
        h, how far ahead the implicit step reaches (s). For |s| well below (h λ)² the law is the
        linear one r = −s/h + w, w' = −s/(2 h)².
    """

    def __init__(self, gain: float, integral_gain: float, most: float, horizon: float) -> None:
        self._gain = gain
        self._horizon = horizon
        self._integral_gain = integral_gain
        self._most = most
        #: w: what has been learned of the disturbance (units of s per time).
        self.integral = 0.0

    def step(
        self, s: float, period: float, *, stretch: float = 1.0, learning: bool = True
    ) -> float:
        """Return r for an output ``s``, wanted for the next ``period`` (s).

        stretch : of the horizon, where calm counts for more than speed.
        learning : whether w follows; not while the input is held back by limits, which are no
            disturbance that more of r could overcome.
        """
        # |s| at the end of the step is z², with z² + h λ z − |s| = 0, z > 0.
        horizon = stretch * self._horizon
        half = 0.5 * self._gain * horizon
        z = math.hypot(half, math.sqrt(abs(s))) - half
        r = (math.copysign(z * z, s) - s) / horizon + self.integral
        if learning:
            rate = s / (2.0 * horizon) ** 2
            rate = max(-self._integral_gain, min(self._integral_gain, rate))
            self.integral = max(-self._most, min(self._most, self.integral - period * rate))
        return r

    def reset(self) -> None:
        """Forget the disturbance."""
        self.integral = 0.0
