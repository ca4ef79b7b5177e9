"""How far the scene is: views on the way to the target, and what the wheels say between them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Health, Views
from visctrl.hal.types import Pose
from visctrl.robots.unicycle import wrap_angle
from visctrl.schemes.arrival.depths import Waypoint, measured_depths, relative_to
from visctrl.schemes.arrival.displacement import (
    SCENE_SPREAD,
    Array,
    Depths,
    Displacement,
    Mask,
    Sighting,
    displacement,
)

#: Depths are measured where the robot has been this far off (m); so many views are used, of so
#: many features at least.
_BASELINE_M, _VIEWS, _FEATURES = 0.15, 6, 8
#: A feature's depth is like that of so many measured ones, if they are this close to it (rad),
#: give or take so much at least (relative); all together by so much (log), besides the scale.
_NEIGHBOURS, _NEAR_RAD, _LEAST_SPREAD, _SCENE_LOG_SD = 5, math.radians(12.0), 0.25, 0.35


@dataclass(frozen=True)
class Passed:
    """A view on the way. camera : where the wheels say the camera was."""

    views: Views
    camera: Pose


@dataclass(frozen=True)
class WayDepths:
    """Inverse depths at the target of the M features that perception followed.

    ids : (M,) their names. rays : (M, 3) unit rays at the target.
    """

    ids: NDArray[np.int64]
    rays: Array
    depths: Depths

    def of(self, ids: NDArray[np.int64]) -> Depths:
        """Return the depths of named features; those of others as far as the scene tells."""
        depths = self._of_scene(len(ids))
        _, here, there = np.intersect1d(ids, self.ids, assume_unique=True, return_indices=True)
        depths.mean[here], depths.sd[here] = self.depths.mean[there], self.depths.sd[there]
        # Not neighbours' depths but their own.
        same = 2 * len(here) > len(ids)
        return replace(depths, scale_sd=self.depths.scale_sd) if same else depths

    def around(self, rays: Array) -> Depths:
        """Return what these depths say of other features of the scene (N, 3): their neighbours'."""
        depths = self._of_scene(len(rays))
        clear = self._clear()
        if clear.sum() < _FEATURES:
            return depths
        apart = np.arccos(np.clip(rays @ self.rays[clear].T, -1.0, 1.0))
        nearest = np.argsort(apart, axis=1)[:, :_NEIGHBOURS]
        close = np.take_along_axis(apart, nearest, axis=1)[:, -1] < _NEAR_RAD
        logs = np.log(self.depths.mean[clear])[nearest]
        mean = np.exp(np.median(logs, axis=1))
        spread = np.clip(logs.std(axis=1), _LEAST_SPREAD, SCENE_SPREAD)
        return replace(
            depths,
            mean=np.where(close, mean, depths.mean),
            sd=np.where(close, spread * mean, depths.sd),
        )

    def _clear(self) -> Mask:
        return np.asarray(self.depths.sd < 0.5 * self.depths.mean)

    def _of_scene(self, count: int) -> Depths:
        clear, unknown = self._clear(), Depths.unknown(count)
        if clear.sum() < _FEATURES:
            return unknown
        middle = float(np.exp(np.median(np.log(self.depths.mean[clear]))))
        mean = np.full(count, middle)
        scale_sd = math.hypot(self.depths.scale_sd, _SCENE_LOG_SD)
        return Depths(mean, SCENE_SPREAD * mean, unknown.floor, scale_sd)


def depths_on_the_way(passed: Sequence[Passed], first: Pose | None = None) -> WayDepths:
    """Measure depths by bundle adjustment over a few of the views, the last one among them.

    first : where the last one was taken in the target's frame, about, if that is known.
    """
    nothing = WayDepths(np.empty(0, dtype=np.int64), np.empty((0, 3)), Depths.unknown(0))
    if not passed or len(passed[-1].views) < _FEATURES:
        return nothing
    last = passed[-1].views
    ways = [relative_to(passed[-1].camera, each.camera) for each in passed]
    distances = np.array([math.hypot(way.x, way.y) for way in ways])
    far = float(distances.max())
    if far < _BASELINE_M:
        return nothing
    wanted = np.geomspace(_BASELINE_M, far, _VIEWS)
    chosen = sorted({int(np.abs(distances - each).argmin()) for each in wanted})
    earlier = []
    for index in chosen:
        rays = _at(last.ids, passed[index].views)
        if np.isfinite(rays[:, 0]).sum() >= _FEATURES:
            earlier.append(Waypoint(sighting(rays, last.sigma), ways[index]))
    if not earlier:
        return nothing
    current = sighting(last.current, last.sigma)
    first = first or displacement(last.target, current).pose
    depths = measured_depths(last.target, current, earlier, first)
    return WayDepths(last.ids, last.target, depths)


def sighting(rays: Array, sigma: float) -> Sighting:
    """Return rays (N, 3) whose directions are off by ``sigma`` (rad) each, as a view."""
    return Sighting(rays, np.broadcast_to(np.eye(2) / max(sigma, 1e-6), (len(rays), 2, 2)))


def _at(ids: NDArray[np.int64], views: Views) -> Array:
    """Return where a view sees named features, rays (N, 3); NaN where it does not."""
    rays = np.full((len(ids), 3), np.nan)
    _, here, there = np.intersect1d(ids, views.ids, assume_unique=True, return_indices=True)
    rays[here] = views.current[there]
    return rays


def seen_displacement(
    views: Views, depths: Depths | None = None, first: Pose | None = None
) -> Displacement | None:
    """Return the displacement between the current and the target view; None if nothing is seen.

    first : where to begin; by default at the target, turned as most bearings are.
    """
    if views.health is Health.LOST or len(views) < _FEATURES:
        return None
    current = sighting(views.current, math.sqrt(2.0) * views.sigma)
    return displacement(views.target, current, depths, first or _turned(views))


def _turned(views: Views) -> Pose:
    """Return the turn that most bearings agree on."""
    now, then = (np.arctan2(rays[:, 0], rays[:, 1]) for rays in (views.current, views.target))
    middle = float(np.angle(np.exp(1j * (now - then)).mean()))
    return Pose(0.0, 0.0, middle + float(np.median(wrap_angle(now - then - middle))))
