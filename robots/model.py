"""What is known of a robot: the typed content of its ``robot.yaml``."""

from __future__ import annotations

import math
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from typing import Annotated, Literal

from pydantic import Field

from visctrl.robots.documents import StrictModel, load, suggestion
from visctrl.robots.errors import InputError

Positive = Annotated[float, Field(gt=0)]


class Limits(StrictModel):
    """Speed and acceleration bounds of a base.

    wheel_m_s, track_m : bound of each wheel's speed |v ± ω b/2|, and b; None for no such bound.
    """

    v_m_s: Positive
    omega_deg_s: Positive
    acceleration_m_s2: Positive
    angular_acceleration_deg_s2: Positive
    wheel_m_s: Positive | None = None
    track_m: Positive | None = None

    @property
    def omega_rad_s(self) -> float:
        """Turning-rate bound (rad/s)."""
        return math.radians(self.omega_deg_s)

    @property
    def angular_acceleration_rad_s2(self) -> float:
        """Angular-acceleration bound (rad/s²)."""
        return math.radians(self.angular_acceleration_deg_s2)

    def ratio(self, v: float, omega: float) -> float:
        """Return a velocity (m/s, rad/s) over its bounds: the largest share of any of them.

        Divided by it where it exceeds 1, both components alike, the path keeps its curvature.
        """
        v, omega = abs(v), abs(omega)
        ratio = max(v / self.v_m_s, omega / self.omega_rad_s)
        if self.wheel_m_s is None or self.track_m is None:
            return ratio
        return max(ratio, (v + omega * self.track_m / 2.0) / self.wheel_m_s)


class Body(StrictModel):
    """Outline and mass. Lengths are measured from the centre of the drive axle."""

    front_m: Positive
    rear_m: Positive
    width_m: Positive
    height_m: Positive
    mass_kg: Positive

    @property
    def radius_m(self) -> float:
        """Radius about the axle's centre of the circle that holds the whole outline (m)."""
        return math.hypot(max(self.front_m, self.rear_m), self.width_m / 2)


class Wheels(StrictModel):
    """Wheels that the base drives."""

    radius_m: Positive
    track_m: Positive
    effective_track_m: Positive
    joints_left: tuple[str, ...]
    joints_right: tuple[str, ...]
    torque_n_m: Positive


class Mount(StrictModel):
    """Where a camera's projection centre sits on the robot."""

    forward_m: float
    height_m: Positive


class Robot(StrictModel):
    """A robot: geometry, limits and mounts, read from its folder's ``robot.yaml``."""

    name: str
    title: str
    drive: Literal["differential", "skid-steer"]
    body: Body
    wheels: Wheels
    operating: Limits
    hardware: Limits
    mounts: dict[str, Mount]

    def mount(self, name: str) -> Mount:
        """Return a camera mount by name.

        Raises
        ------
        InputError
            The robot has no such mount; the message lists those it has.
        """
        if name not in self.mounts:
            raise InputError(
                f"robot '{self.name}' has no camera mount '{name}'; {suggestion(name, self.mounts)}"
            )
        return self.mounts[name]

    def urdf(self) -> Traversable:
        """Return the robot's URDF file (package data)."""
        return resources.files("visctrl.robots") / self.name / "robot.urdf"


@cache
def robot_names() -> tuple[str, ...]:
    """Return the names of the robots that this package holds."""
    folders = resources.files("visctrl.robots").iterdir()
    return tuple(sorted(f.name for f in folders if f.is_dir() and (f / "robot.yaml").is_file()))


@cache
def load_robot(name: str) -> Robot:
    """Return a robot by its folder's name.

    Raises
    ------
    InputError
        No such robot; the message lists those there are.
    """
    if name not in robot_names():
        raise InputError(f"unknown robot '{name}'; {suggestion(name, robot_names())}")
    return load(resources.files("visctrl.robots") / name / "robot.yaml", Robot)
