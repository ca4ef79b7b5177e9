"""Robots that speak ARCOS, by the name of the subclass that they give in the handshake.

What is known of each is in its ``robot.yaml`` (section ``arcos``); here it is looked up.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

from visctrl.hal.errors import InputError, LinkError
from visctrl.robots import Robot, load_robot, robot_names
from visctrl.robots.arcos import Arcos, Units
from visctrl.robots.documents import suggestion
from visctrl.robots.sonar import SonarRing

#: Heading units to radians. The parameter files print it rounded to 0.00153, which makes an
#: error of 0.26 %: a turn has exactly 4096 units.
HEADING_RAD = 2.0 * math.pi / 4096.0


_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Subclass:
    """A kind of controller in a robot.

    name : as the handshake gives it, in lower case. units : of its counters.
    """

    name: str
    robot: Robot
    arcos: Arcos
    units: Units

    @property
    def sonar(self) -> SonarRing | None:
        """The robot's sonar ring."""
        return self.robot.sonar


def subclasses_of(robot: Robot) -> dict[str, Subclass]:
    """Return the controllers that a robot may have, by name; none if it speaks no ARCOS."""
    if robot.arcos is None:
        return {}
    return {
        name.lower(): Subclass(name.lower(), robot, robot.arcos, units)
        for name, units in robot.arcos.subclasses.items()
    }


@cache
def known_subclasses() -> dict[str, Subclass]:
    """Return the controllers of all robots that are installed, by name."""
    found: dict[str, Subclass] = {}
    for name in robot_names():
        try:
            found.update(subclasses_of(load_robot(name)))
        except InputError as error:  # another package's, which is broken: these here still drive
            _log.warning("%s", error)
    return found


def find_subclass(name: str, robots: Iterable[Robot] = ()) -> Subclass:
    """Return what is known of a controller, whatever the case of its name.

    Parameters
    ----------
    name : str
        As the handshake gives it.
    robots : iterable of Robot
        Where to look first; then in those that are installed.

    Raises
    ------
    LinkError
        The robot is of a kind that is not known here.
    """
    wanted = name.lower()
    for robot in robots:
        if wanted in (known := subclasses_of(robot)):
            return known[wanted]
    if wanted in known_subclasses():
        return known_subclasses()[wanted]
    raise LinkError(
        f"the robot calls itself '{name}', which is not known here; "
        f"{suggestion(wanted, known_subclasses())}; another one needs a robot.yaml with its units "
        "(arcos.subclasses) and --robot"
    )


def expected_subclass(name: str, robot: Robot, url: str) -> Subclass:
    """Return what is known of a controller that must be one of ``robot``'s.

    Raises
    ------
    InputError
        It is another robot's; the message names it.
    LinkError
        It is not known here.
    """
    found = find_subclass(name, (robot,))
    if name.lower() not in subclasses_of(robot):
        raise InputError(
            f"the robot on {url} is a '{name}', not a '{robot.name}': use --robot "
            f"{found.robot.name}"
        )
    return found
