"""A robot's ring of sonar transducers, as its ``robot.yaml`` describes it."""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from pydantic import Field

from visctrl.robots.documents import StrictModel

Finite = Annotated[float, Field(allow_inf_nan=False)]


class Transducer(NamedTuple):
    """Position ahead and to the left of the axle's centre (m), direction (deg, left positive)."""

    forward_m: Finite
    left_m: Finite
    direction_deg: Finite

    @property
    def direction_rad(self) -> float:
        """Direction in which it looks (rad, left positive)."""
        return math.radians(self.direction_deg)


class SonarRing(StrictModel):
    """Sonar transducers at one height.

    range_m : what is reported where nothing echoes. height_m : of the ring above the floor.
    cone_deg : full opening of a transducer's cone. transducers : by number.
    """

    range_m: Annotated[float, Field(gt=0.0)]
    height_m: Annotated[float, Field(gt=0.0)]
    cone_deg: Annotated[float, Field(gt=0.0, lt=180.0)]
    transducers: Annotated[
        dict[Annotated[int, Field(ge=0, lt=32)], Transducer], Field(min_length=1)
    ]

    @property
    def ray_angles(self) -> tuple[float, ...]:
        """Five directions spread evenly across a cone (rad, about its axis)."""
        return tuple(math.radians(self.cone_deg * share / 4.0) for share in (-2, -1, 0, 1, 2))
