"""Light that falls on a scene: how bright each of its surfaces is, painted on.

Surfaces are lit by their normal alone (Lambert's law about a mean): no shadows, no reflections.
"""

from __future__ import annotations

import math
import zlib
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from visctrl.robots.documents import StrictModel

Array = NDArray[np.float64]

_ELEVATION = math.radians(35.0)
_LEAST, _MOST = 0.05, 4.0


class Light(StrictModel):
    """How light differs from the even one of the scene's own shades.

    brightness : factor of all shades; 0.2 is dim.
    side : share of the light that comes from one side, 35 deg above the horizon; 0.5 makes what
        faces it half as bright again and leaves half on what looks away.
    from_deg : from where, clockwise from the target's forward direction.
    tint : standard deviation of a factor that every thing has of its own: light of another
        colour changes the greys of different paints differently.
    """

    brightness: Annotated[float, Field(gt=0.0, le=4.0)] = 1.0
    side: Annotated[float, Field(ge=0.0, le=0.9)] = 0.0
    from_deg: float = 90.0
    tint: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0

    def gain(self, normal: Array, name: str) -> float:
        """Return the factor of a shade, for a surface's unit normal (3,) and its thing's name."""
        if self == _EVEN:
            return 1.0
        bearing = math.radians(self.from_deg)
        level = math.cos(_ELEVATION)
        towards = np.array(
            [level * math.sin(bearing), level * math.cos(bearing), math.sin(_ELEVATION)]
        )
        gain = self.brightness * (1.0 + self.side * float(normal @ towards))
        if self.tint > 0.0:
            rng = np.random.default_rng(zlib.crc32(name.encode()))
            gain *= math.exp(self.tint * float(rng.standard_normal()))
        return min(max(gain, _LEAST), _MOST)


_EVEN = Light()
