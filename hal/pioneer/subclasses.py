"""What differs between robots that speak ARCOS: conversion factors and sonar rings.

The robot names its subclass in the handshake. Factors: the parameter files that the vendor's
client library ships (``p3dx-sh.p`` and its like); names ending in ``-sh`` have the controller
of 2004 and later, which counts millimetres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from visctrl.hal.errors import LinkError
from visctrl.robots.documents import suggestion

#: Heading units to radians. The parameter files print it rounded to 0.00153, which makes an
#: error of 0.26 %: a turn has exactly 4096 units.
HEADING_RAD = 2.0 * math.pi / 4096.0
#: Range that the firmware reports where nothing echoes (m).
NO_ECHO_M = 5.0
#: Step of VEL2 (mm/s).
VEL2_STEP = 20


@dataclass(frozen=True)
class SonarPose:
    """A transducer: position ahead and to the left of the axle's centre (m), direction (rad)."""

    forward_m: float
    left_m: float
    direction_rad: float


@dataclass(frozen=True)
class Subclass:
    """Factors from the firmware's units to SI.

    robot : name of the description in `robots`.
    distance_mm : millimetres per odometry unit. range_mm : millimetres per sonar unit.
    turn_per_difference : rad/s per mm/s of half the wheels' speed difference.
    """

    name: str
    robot: str
    distance_mm: float
    range_mm: float
    turn_per_difference: float
    sonar: tuple[SonarPose, ...]


def _ring(*rows: tuple[int, int, int]) -> tuple[SonarPose, ...]:
    """Return both halves of a ring from its left transducers, front to rear."""
    poses = [SonarPose(x / 1e3, y / 1e3, math.radians(a)) for x, y, a in rows]
    mirrored = [SonarPose(p.forward_m, -p.left_m, -p.direction_rad) for p in poses]
    front, rear = poses[:4], poses[4:]
    return (*front, *reversed(mirrored[:4]), *mirrored[4:], *reversed(rear))


_DX_RING = _ring(
    *((69, 136, 90), (114, 119, 50), (148, 78, 30), (166, 27, 10)),
    *((-157, 136, 90), (-203, 119, 130), (-237, 78, 150), (-255, 27, 170)),
)
_AT_RING = _ring(
    *((147, 136, 90), (193, 119, 50), (227, 79, 30), (245, 27, 10)),
    *((-144, 136, 90), (-189, 119, 130), (-223, 79, 150), (-241, 27, 170)),
)


def _dx(name: str, distance_mm: float = 1.0, range_mm: float = 1.0) -> Subclass:
    return Subclass(name, "p3dx", distance_mm, range_mm, 0.0056, _DX_RING)


def _at(name: str, distance_mm: float = 1.0, range_mm: float = 1.0) -> Subclass:
    return Subclass(name, "p3at", distance_mm, range_mm, 0.0034, _AT_RING)


SUBCLASSES = {
    subclass.name: subclass
    for subclass in (
        _dx("p3dx-sh"),
        _dx("p3dx-sh-lms1xx"),
        _dx("p3dx-sh-lms500"),
        _dx("p3dx", 0.485),
        _dx("p2dx", 0.84, 0.268),
        _at("p3at-sh"),
        _at("p3at-sh-lms1xx"),
        _at("p3at-sh-lms500"),
        _at("p3atiw-sh"),
        _at("p3at", 0.465),
        _at("p2at", 1.32, 0.268),
    )
}


def ring_of(robot: str) -> tuple[SonarPose, ...]:
    """Return the sonar ring of a robot of `robots`; empty if it is none of ARCOS'."""
    for subclass in SUBCLASSES.values():
        if subclass.robot == robot:
            return subclass.sonar
    return ()


def find_subclass(name: str) -> Subclass:
    """Return the factors of a subclass, whatever the case of its name.

    Raises
    ------
    LinkError
        The robot is of a kind that is not known here.
    """
    subclass = SUBCLASSES.get(name.lower())
    if subclass is None:
        raise LinkError(
            f"the robot calls itself '{name}', which is not known here; "
            f"{suggestion(name.lower(), SUBCLASSES)}"
        )
    return subclass
