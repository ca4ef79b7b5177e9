"""Depths of the target's features: bundle adjustment of earlier views, scaled by the wheels.

Unknown are the poses of V views in the target's frame, the scene's and every feature's inverse
depth and the scale of the wheels' distances. Every feature's depth is eliminated (Schur
complement); Cauchy weights keep off what has moved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visctrl.hal.types import Pose
from visctrl.robots.unicycle import wrap_angle
from visctrl.schemes.arrival.displacement import (
    CAUCHY,
    SCENE_LOG,
    SCENE_LOG_SD,
    SCENE_SPREAD,
    Array,
    Depths,
    Linearised,
    Sighting,
)

#: Entries of the common part that are no pose: log of the scene's inverse depth, wheels' scale.
_SCENE, _SCALE, _SHARED = 0, 1, 2
#: What wheels may be off by: their scale (relative), and each distance and turn beyond that.
WHEEL_SCALE_SD, WHEEL_SD, WHEEL_SD_M, WHEEL_SD_RAD = 0.15, 0.05, 0.005, math.radians(3.0)
_LEAST_INVERSE_DEPTH = 1e-3
_ROUNDS, _SETTLED = 25, 1e-6
#: What a pose is known to beforehand (m, rad), about where it was begun with.
_ANYWHERE = 10.0
_LEAST_DAMPING, _MOST_DAMPING = 1e-9, 1e8


@dataclass(frozen=True)
class Waypoint:
    """An earlier view, and where the wheels say it was taken.

    relative : pose of the earlier camera in the last camera's frame.
    """

    sighting: Sighting
    relative: Pose


def composed(base: Pose, relative: Pose) -> Pose:
    """Return the pose whose place in the frame of ``base`` is ``relative``."""
    c, s = math.cos(base.phi), math.sin(base.phi)
    return Pose(
        base.x + c * relative.x - s * relative.y,
        base.y + s * relative.x + c * relative.y,
        base.phi + relative.phi,
    )


def relative_to(base: Pose, pose: Pose) -> Pose:
    """Return where ``pose`` is in the frame of ``base``."""
    c, s, dx, dy = math.cos(base.phi), math.sin(base.phi), pose.x - base.x, pose.y - base.y
    turn = float(wrap_angle(pose.phi - base.phi))
    return Pose(c * dx + s * dy, c * dy - s * dx, turn)


def measured_depths(
    target: Array, current: Sighting, earlier: Sequence[Waypoint], first: Pose
) -> Depths:
    """Measure the inverse depths of N features at the target.

    Parameters
    ----------
    target : (N, 3)
        Unit rays at the target.
    current : Sighting
        The last view, near the target.
    earlier : sequence of Waypoint
        Views from somewhere else.
    first : Pose
        Pose of the last view in the target's frame, about.
    """
    relative = np.array([each.relative for each in earlier])
    bundle = _Bundle(target, [current, *(each.sighting for each in earlier)], relative)
    poses = np.array([first, *(composed(first, each.relative) for each in earlier)])
    state, system = bundle.solve(poses)
    # A calibration that is wrong shows in the residuals.
    wider = math.sqrt(max(1.0, system.excess))
    scale = min(math.sqrt(system.covariance()[_SCALE, _SCALE]) * wider, SCENE_LOG_SD)
    nowhere = np.zeros(len(target), dtype=np.bool_)
    return Depths(state.depths, wider / np.sqrt(system.depth), nowhere, scale)


@dataclass(frozen=True)
class _State:
    poses: Array
    shared: Array
    depths: Array


class _Bundle:
    """Levenberg–Marquardt over V poses, the shared part and N inverse depths."""

    def __init__(self, target: Array, views: Sequence[Sighting], relative: Array) -> None:
        self._target = target
        self._rays = np.stack([view.rays for view in views])
        self._seen = np.asarray(np.isfinite(self._rays).all(axis=-1))
        whiten = np.stack([view.whiten for view in views])
        self._whiten = np.where(self._seen[..., None, None], whiten, 0.0)
        self._rays = np.where(self._seen[..., None], self._rays, target)
        self._relative = relative

    def solve(self, poses: Array) -> tuple[_State, _Equations]:
        shared = np.array([SCENE_LOG, 0.0])
        state = _State(poses, shared, np.full(len(self._target), math.exp(SCENE_LOG)))
        system = self._equations(state)
        damping = 1e-3
        while damping < _MOST_DAMPING and system.rounds < _ROUNDS:
            step, depth_step = system.step(damping)
            tried = _State(
                state.poses + step[_SHARED:].reshape(-1, 3),
                np.clip(state.shared + step[:_SHARED], (-4.0, -0.9), (2.0, 2.0)),
                np.maximum(state.depths + depth_step, _LEAST_INVERSE_DEPTH),
            )
            there = self._equations(tried)
            if there.cost > system.cost:
                damping *= 10.0
                continue
            there.rounds = system.rounds + 1
            state, system = tried, there
            damping = max(damping / 10.0, _LEAST_DAMPING)
            if np.abs(step).max() < _SETTLED:
                break
        return state, system

    def _equations(self, state: _State) -> _Equations:
        at = Linearised(self._target, self._rays, state.poses, state.depths)
        white = self._whiten
        residual = (white @ at.error[..., None])[..., 0]
        by_pose = white @ at.by_pose
        by_depth = (white @ at.by_depth[..., None])[..., 0]
        squared = (residual**2).sum(axis=-1)
        weight = np.where(self._seen, 1.0 / (1.0 + squared / CAUCHY**2), 0.0)
        cost = CAUCHY**2 * float(np.log1p(squared / CAUCHY**2)[self._seen].sum())
        system = _Equations(cost, _SHARED + 3 * len(state.poses), len(state.depths))
        freedom = 2.0 * float(weight.sum()) - len(state.depths) - 3.0 * len(state.poses)
        system.excess = float((weight * squared).sum()) / max(1.0, freedom)
        for v, part in enumerate(by_pose):
            columns = slice(_SHARED + 3 * v, _SHARED + 3 * v + 3)
            weighted = weight[v, :, None, None] * part
            system.common[columns, columns] = np.einsum("nri,nrj->ij", weighted, part)
            system.rhs[columns] = np.einsum("nri,nr->i", weighted, residual[v])
            system.cross[:, columns] = np.einsum("nri,nr->ni", weighted, by_depth[v])
        system.depth += np.einsum("vn,vnr,vnr->n", weight, by_depth, by_depth)
        system.depth_rhs += np.einsum("vn,vnr,vnr->n", weight, by_depth, residual)
        # The last view is known roughly, for features that determine nothing.
        poses = range(_SHARED, len(system.rhs))
        system.common[poses, poses] += 1.0 / _ANYWHERE**2
        self._add_scene(state, system)
        self._add_wheels(state, system)
        return system

    def _add_scene(self, state: _State, system: _Equations) -> None:
        """Add that depths lie about the scene's, by a share of it: no scale is preferred."""
        scene = math.exp(state.shared[_SCENE])
        off = (1.0 - state.depths / scene) / SCENE_SPREAD
        by_depth, by_scene = 1.0 / (scene * SCENE_SPREAD), -state.depths / (scene * SCENE_SPREAD)
        weight = 1.0 / (1.0 + off**2 / CAUCHY**2)
        system.cost += CAUCHY**2 * float(np.log1p(off**2 / CAUCHY**2).sum())
        system.depth += weight * by_depth**2
        system.depth_rhs += weight * by_depth * off
        system.cross[:, _SCENE] += weight * by_depth * by_scene
        system.common[_SCENE, _SCENE] += float((weight * by_scene**2).sum())
        system.rhs[_SCENE] += float((weight * by_scene * off).sum())
        for k, mean, deviation in ((_SCENE, SCENE_LOG, SCENE_LOG_SD), (_SCALE, 0, WHEEL_SCALE_SD)):
            away = (mean - state.shared[k]) / deviation
            system.common[k, k] += 1.0 / deviation**2
            system.rhs[k] += away / deviation
            system.cost += away**2

    def _add_wheels(self, state: _State, system: _Equations) -> None:
        """Add what the wheels say of the earlier views."""
        poses, scale = state.poses, 1.0 + state.shared[_SCALE]
        c, s = math.cos(poses[0, 2]), math.sin(poses[0, 2])
        last = _SHARED
        for v, (x, y, turn) in enumerate(self._relative, start=1):
            way = np.array([c * x - s * y, s * x + c * y])
            sd = WHEEL_SD_M + WHEEL_SD * math.hypot(x, y)
            off = np.append(
                (poses[0, :2] + scale * way - poses[v, :2]) / sd,
                wrap_angle(poses[0, 2] + turn - poses[v, 2]) / WHEEL_SD_RAD,
            )
            by = np.zeros((3, len(system.rhs)))
            at = _SHARED + 3 * v
            by[0, at] = by[1, at + 1] = 1.0 / sd
            by[0, last] = by[1, last + 1] = -1.0 / sd
            by[:2, last + 2] = scale * np.array([way[1], -way[0]]) / sd
            by[:2, _SCALE] = -way / sd
            by[2, at + 2], by[2, last + 2] = 1.0 / WHEEL_SD_RAD, -1.0 / WHEEL_SD_RAD
            system.common += by.T @ by
            system.rhs += by.T @ off
            system.cost += float(off @ off)


class _Equations:
    """Normal equations in arrow shape: the common part, the depths' diagonal, what couples them."""

    def __init__(self, cost: float, count: int, features: int) -> None:
        self.cost = cost
        self.rounds = 0
        self.excess = 1.0
        self.common, self.rhs = np.zeros((count, count)), np.zeros(count)
        self.cross = np.zeros((features, count))
        self.depth, self.depth_rhs = np.zeros(features), np.zeros(features)

    def step(self, damping: float) -> tuple[Array, Array]:
        """Return the damped step of the common part and of the depths."""
        depth = self.depth * (1.0 + damping)
        share = self.cross / depth[:, None]
        common = self.common + damping * np.diag(np.diag(self.common))
        step = np.linalg.solve(common - self.cross.T @ share, self.rhs - share.T @ self.depth_rhs)
        return np.asarray(step, float), (self.depth_rhs - self.cross @ step) / depth

    def covariance(self) -> Array:
        """Return the covariance of the common part."""
        share = self.cross / self.depth[:, None]
        return np.asarray(np.linalg.inv(self.common - self.cross.T @ share))
