"""Small parts of sliding-mode laws: switching terms and reference trajectories."""

from __future__ import annotations

import math
from dataclasses import dataclass


def switching(s: float, layer: float) -> float:
    """Return sign(s), or s/layer inside a boundary layer; 0 is the discontinuous law."""
    if layer > 0.0:
        return max(-1.0, min(1.0, s / layer))
    return math.copysign(1.0, s) if s != 0.0 else 0.0


@dataclass(frozen=True)
class CosineDescent:
    """The reference (1 + cos α)/(1 + cos α0), α from α0 to π in ``duration`` seconds, then 0.

    With α0 = 0 it is (3.11), which starts at rest; another start joins on to a motion that is
    already under way.
    """

    duration: float
    start_angle: float = 0.0

    @classmethod
    def joining(cls, duration: float, slope: float) -> CosineDescent:
        """Return the descent that starts with the rate −``slope`` (1/s, 0 ≤ slope)."""
        # The starting rate is (π − α0) tan(α0/2) / duration, which grows with α0 on [0, 2].
        low, high = 0.0, 2.0
        for _ in range(40):
            middle = (low + high) / 2.0
            if (math.pi - middle) * math.tan(middle / 2.0) < slope * duration:
                low = middle
            else:
                high = middle
        return cls(duration, low)

    def at(self, t: float) -> tuple[float, float]:
        """Return the reference at ``t`` (s) and its rate (1/s)."""
        if t >= self.duration:
            return 0.0, 0.0
        pace = (math.pi - self.start_angle) / self.duration
        angle = self.start_angle + pace * max(t, 0.0)
        height = 1.0 + math.cos(self.start_angle)
        return (1.0 + math.cos(angle)) / height, -pace * math.sin(angle) / height
