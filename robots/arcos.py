"""What the ARCOS serial protocol needs to know of a robot: units, and settings as delivered."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from visctrl.robots.documents import StrictModel

Positive = Annotated[float, Field(gt=0)]
Word = Annotated[int, Field(ge=0, le=0xFFFF)]


class Units(StrictModel):
    """What the counters of one kind of controller count.

    distance_mm : millimetres per odometry unit. range_mm : millimetres per sonar unit.
    """

    distance_mm: Positive = 1.0
    range_mm: Positive = 1.0


class Flash(StrictModel):
    """Settings in which the robots' controllers differ as delivered; the emulator has them.

    Speeds in mm/s and deg/s, accelerations in mm/s² and deg/s²; ``top`` is what the controller
    can be set to, ``max`` what it is set to. front_bumpers, rear_bumpers : segments.
    """

    speed_max: Word
    speed_top: Word
    turn_max: Word
    turn_top: Word
    acceleration_top: Word = 4000
    turn_acceleration_top: Word = 600
    rev_count: Word = 0
    ticks_per_mm: Word = 0
    front_bumpers: Annotated[int, Field(ge=0, le=7)] = 0
    rear_bumpers: Annotated[int, Field(ge=0, le=7)] = 0


class Arcos(StrictModel):
    """A robot that speaks ARCOS.

    turn_per_difference : rad/s per mm/s of half the wheels' speed difference (DiffConvFactor).
    vel2_step_mm_s : step of the command VEL2 (Vel2Divisor).
    subclasses : names by which its controllers call themselves in the handshake, in lower case,
        and their units.
    """

    turn_per_difference: Positive
    vel2_step_mm_s: Annotated[int, Field(gt=0, le=1000)] = 20
    subclasses: Annotated[dict[str, Units], Field(min_length=1)]
    flash: Flash
