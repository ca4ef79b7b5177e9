"""Obstacle provider ``sonar``: what the base's range sensors meet."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from visctrl.contracts import Context, Obstacle, ObstacleProvider, Signal
from visctrl.hal.types import Pose, Range
from visctrl.planning.providers.occupancy_grid import CELL_M, EchoMap, Reading
from visctrl.robots.documents import StrictModel
from visctrl.robots.unicycle import relative_pose
from visctrl.schemes.pose.estimate import PoseEstimate

Positive = Annotated[float, Field(gt=0.0)]

#: Radius of an occupied cell, and of a single echo while the robot does not know where it is (m).
_CELL_RADIUS_M = CELL_M / math.sqrt(2.0)
_ECHO_RADIUS_M = 0.1
#: Older readings are not used, nor are older poses kept (s).
_OLDEST_S = 1.0
#: Times this close (s) are the same.
_SAME_S = 1e-6


class SonarOptions(StrictModel):
    """Options of `Sonar`.

    reach_m : readings are believed up to this distance; a longer one only says that nothing is
        nearer.
    cone_deg : full opening of a sensor's cone.
    forget_s : what is not confirmed fades with this time constant.
    """

    reach_m: Positive = 1.8
    cone_deg: Annotated[float, Field(gt=1.0, le=90.0)] = 24.0
    forget_s: Positive = 60.0


class Sonar(ObstacleProvider[SonarOptions, PoseEstimate]):
    """Obstacles that range sensors meet, gathered in an `EchoMap`.

    The map lies in the frame of the initial view: how far the robot has come since then is what
    it knows best, while where the target is may still be found better.
    """

    Options: ClassVar[type[SonarOptions]] = SonarOptions
    accepts: ClassVar[type[PoseEstimate]] = PoseEstimate
    listens: ClassVar[bool] = True
    signals: ClassVar[tuple[Signal, ...]] = (Signal("cells", "1"), Signal("nearest", "m"))

    def __init__(self, options: SonarOptions, context: Context) -> None:
        super().__init__(options, context)
        self._map = EchoMap(options.reach_m, math.radians(options.cone_deg))
        self._poses: deque[tuple[float, float, float, float]] = deque()
        self._heard: dict[tuple[float, float, float], float] = {}
        self._now: float | None = None
        self._found: list[Obstacle] = []

    def update(
        self, estimate: PoseEstimate, ranges: Sequence[Range], now: float
    ) -> Sequence[Obstacle]:
        """Return the cells of the map that are occupied (see the contract).

        Until the pose is known there is no map: the present echoes are all there is.
        """
        fresh = self._fresh(ranges, now)
        if not estimate.known:
            self._found = self._echoes(ranges)
            return self._found
        camera = Pose(*relative_pose(estimate.pose, estimate.initial).tolist())
        self._poses.append((now, *camera))
        while self._poses[0][0] < now - _OLDEST_S:
            self._poses.popleft()
        self._map.follow(camera.x, camera.y)
        if self._now is not None:
            self._map.forget(-math.expm1((self._now - now) / self.options.forget_s))
        self._now = now
        self._map.take([self._placed(reading, now) for reading in fresh])
        self._clear_own_place(camera)
        self._found = self._seen_from(camera)
        return self._found

    def values(self) -> Mapping[str, float]:
        """Return how many cells are occupied, and how far the nearest is from the camera."""
        found = {"cells": float(len(self._found))}
        if self._found:
            found["nearest"] = min(math.hypot(o.right, o.forward) for o in self._found)
        return found

    def notes(self) -> Sequence[str]:
        """Say so if no range sensor has ever said anything."""
        return () if self._heard else ("sonar: no range sensor has said anything",)

    def _fresh(self, ranges: Sequence[Range], now: float) -> list[Range]:
        """Return the readings that are new and not too old."""
        fresh = []
        for reading in ranges:
            sensor, heard = reading[:3], now - reading.age
            if reading.age <= _OLDEST_S and heard > self._heard.get(sensor, -math.inf) + _SAME_S:
                self._heard[sensor] = heard
                fresh.append(reading)
        return fresh

    def _placed(self, reading: Range, now: float) -> Reading:
        """Return a reading in the map's frame, made from where the robot was at that time."""
        x, y, phi = self._pose_at(now - reading.age)
        s, c = math.sin(phi), math.cos(phi)
        right, forward = reading.right, reading.forward - self.context.camera_forward_m
        return Reading(
            x + c * right - s * forward,
            y + s * right + c * forward,
            phi - reading.bearing,
            reading.distance,
        )

    def _pose_at(self, time: float) -> tuple[float, float, float]:
        """Return the camera's pose at a time that has just passed."""
        later = self._poses[-1]
        for earlier in reversed(self._poses):
            if earlier[0] <= time:
                span = later[0] - earlier[0]
                share = (time - earlier[0]) / span if span > 0.0 else 0.0
                turn = math.remainder(later[3] - earlier[3], math.tau)
                return (
                    earlier[1] + share * (later[1] - earlier[1]),
                    earlier[2] + share * (later[2] - earlier[2]),
                    earlier[3] + share * turn,
                )
            later = earlier
        return later[1:]

    def _clear_own_place(self, camera: Pose) -> None:
        body, ahead = self.context.body, -self.context.camera_forward_m
        if body is not None:
            s, c = math.sin(camera.phi), math.cos(camera.phi)
            self._map.free(camera.x - s * ahead, camera.y + c * ahead, body.width_m / 2.0)

    def _seen_from(self, camera: Pose) -> list[Obstacle]:
        cells = self._map.occupied() - np.array(camera[:2])
        s, c = math.sin(camera.phi), math.cos(camera.phi)
        seen = cells @ np.array([[c, -s], [s, c]])
        return [Obstacle(x, y, _CELL_RADIUS_M, certain=False) for x, y in seen.tolist()]

    def _echoes(self, ranges: Sequence[Range]) -> list[Obstacle]:
        """Return a disc for every echo, in the middle of its cone."""
        found = []
        for reading in ranges:
            if reading.distance < self.options.reach_m:
                away = reading.distance + _ECHO_RADIUS_M
                found.append(
                    Obstacle(
                        reading.right + away * math.sin(reading.bearing),
                        reading.forward
                        - self.context.camera_forward_m
                        + away * math.cos(reading.bearing),
                        _ECHO_RADIUS_M,
                        certain=False,
                    )
                )
        return found
