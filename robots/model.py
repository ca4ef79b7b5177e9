"""What is known of a robot: the typed content of its ``robot.yaml``.

A robot is a folder with a ``robot.yaml`` and, for physics, a ``robot.urdf`` beside it. It is
found by name, among those of this package and those that installed packages announce, or by path.
"""

from __future__ import annotations

import math
import os
from functools import cache
from importlib import resources
from importlib.metadata import entry_points
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, PrivateAttr

from visctrl.robots.arcos import Arcos
from visctrl.robots.documents import StrictModel, load, suggestion
from visctrl.robots.errors import InputError
from visctrl.robots.loading import load_module
from visctrl.robots.sonar import SonarRing

#: Entry points that name a package with a ``robot.yaml`` in it.
GROUP = "visctrl.robots"
_FILE = "robot.yaml"

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
    """A robot: geometry, limits and mounts, read from its folder's ``robot.yaml``.

    sonar : its ring of sonar transducers; None without. arcos : for the serial protocol of the
    Pioneers; None for a robot that does not speak it.
    """

    name: str
    title: str
    drive: Literal["differential", "skid-steer"]
    body: Body
    wheels: Wheels
    operating: Limits
    hardware: Limits
    mounts: dict[str, Mount]
    sonar: SonarRing | None = None
    arcos: Arcos | None = None

    _folder: Traversable | None = PrivateAttr(default=None)

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
        """Return the robot's URDF file.

        Raises
        ------
        InputError
            There is none beside its ``robot.yaml``.
        """
        urdf = None if self._folder is None else self._folder / "robot.urdf"
        if urdf is None or not urdf.is_file():
            raise InputError(
                f"robot '{self.name}': there is no robot.urdf beside its robot.yaml, and only "
                "simulated physics needs one: use another backend, or write it"
            )
        return urdf


@cache
def robot_names() -> tuple[str, ...]:
    """Return the names of the robots of this package and of packages that announce some."""
    return tuple(sorted({*_own(), *_announced()}))


def load_robot(name: str) -> Robot:
    """Return a robot by name, or by the path of its ``robot.yaml`` or of the folder around it.

    Raises
    ------
    InputError
        No such robot (the message lists those there are), or its file cannot be used.
    """
    return _read(*_place(name))


def is_path(name: str) -> bool:
    """Return whether a robot is named by a path: one with a slash, or a YAML file's name."""
    return name.endswith((".yaml", ".yml")) or "/" in name or "\\" in name


def _place(name: str) -> tuple[str, Path | None]:
    """Return a key for the cache, and the file behind it where it is one of the user's."""
    if not is_path(name):
        return name, None
    path = Path(name)
    path = path / _FILE if os.path.isdir(path) else path
    return os.path.realpath(path), path


@cache
def _read(name: str, path: Path | None) -> Robot:
    if path is not None:
        robot = load(path, Robot)
        robot._folder = Path(os.path.realpath(path)).parent
        return robot
    if name in _own():
        folder = _own()[name]
    elif name in _announced():
        folder = _package_folder(name, _announced()[name])
    else:
        raise InputError(
            f"unknown robot '{name}'; {suggestion(name, robot_names())}; a robot of your own is "
            "named by the path of its robot.yaml, as in ./my_robot"
        )
    robot = load(folder / _FILE, Robot)
    robot._folder = folder
    return robot


@cache
def _own() -> dict[str, Traversable]:
    folders = resources.files("visctrl.robots").iterdir()
    return {f.name: f for f in folders if f.is_dir() and (f / _FILE).is_file()}


@cache
def _announced() -> dict[str, str]:
    return {point.name: point.value for point in entry_points(group=GROUP)}


def _package_folder(name: str, package: str) -> Traversable:
    what = f"robot '{name}': package {package}"
    try:
        return resources.files(load_module(package, what))
    except TypeError as error:
        raise InputError(f"{what} cannot be read: {error}") from error
