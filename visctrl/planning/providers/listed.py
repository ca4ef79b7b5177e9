"""Obstacle provider ``listed``: those of the scenario, each noticed when the camera comes near."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar

from pydantic import Field

from visctrl.contracts import Context, Obstacle, ObstacleProvider, Signal
from visctrl.hal.types import Pose, Range
from visctrl.robots.documents import StrictModel
from visctrl.schemes.pose.estimate import PoseEstimate

Positive = Annotated[float, Field(gt=0.0)]

_AT_TARGET = Pose(0.0, 0.0, 0.0)
#: The robot may be this many standard deviations from where it believes to be …
_SIGMAS = 2.0
#: … but obstacles do not grow by more than this (m), or a start far away has no way at all.
_GROWS_M = 0.3


class Disc(StrictModel):
    """An obstacle of which the robot learns when it comes near.

    x_m, y_m, radius_m : in the target's frame.
    noticed_m : distance of the camera from its edge at which it is noticed.
    """

    x_m: float
    y_m: float
    radius_m: Positive = 0.3
    noticed_m: Positive = 2.0

    def seen_from(self, pose: Pose, grown: float = 0.0) -> Obstacle:
        """Return it as seen from a camera pose (m, m, rad), its radius ``grown`` by so much."""
        s, c = math.sin(pose.phi), math.cos(pose.phi)
        dx, dy = self.x_m - pose.x, self.y_m - pose.y
        return Obstacle(c * dx + s * dy, c * dy - s * dx, self.radius_m + grown)


class ListedOptions(StrictModel):
    """Options of `Listed`."""

    discs: tuple[Disc, ...] = ()


class Listed(ObstacleProvider[ListedOptions, PoseEstimate]):
    """Obstacles of the scenario; once noticed, they stay.

    Their places are exact and the robot's own is not: they are reported larger by what the
    estimated pose may be off.
    """

    Options: ClassVar[type[ListedOptions]] = ListedOptions
    accepts: ClassVar[type[PoseEstimate]] = PoseEstimate
    signals: ClassVar[tuple[Signal, ...]] = (Signal("noticed", "1"),)

    def __init__(self, options: ListedOptions, context: Context) -> None:
        super().__init__(options, context)
        self._ahead = list(options.discs)
        self._noticed: list[Disc] = []

    def update(
        self, estimate: PoseEstimate, ranges: Sequence[Range], now: float
    ) -> Sequence[Obstacle]:
        """Return those that the camera has been near enough to (see the contract)."""
        del ranges, now
        if not estimate.known:
            return ()
        pose = estimate.pose
        for disc in list(self._ahead):
            away = math.hypot(disc.x_m - pose.x, disc.y_m - pose.y) - disc.radius_m
            if away <= disc.noticed_m:
                self._ahead.remove(disc)
                self._noticed.append(disc)
        grown = min(_SIGMAS * estimate.position_sd, _GROWS_M)
        return [disc.seen_from(pose, grown) for disc in self._noticed]

    def expected(self) -> Sequence[Obstacle]:
        """Return all of them (see the contract)."""
        return [disc.seen_from(_AT_TARGET) for disc in self.options.discs]

    def values(self) -> Mapping[str, float]:
        """Return how many have been noticed."""
        return {"noticed": float(len(self._noticed))}
