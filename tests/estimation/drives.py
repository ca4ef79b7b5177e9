"""Drives of an exact unicycle past a scene, as an estimator sees them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from visctrl.contracts import Context, Health, Views
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.types import Velocity
from visctrl.robots import load_robot
from visctrl.robots.unicycle import step_exact

PERIOD = 0.1
SIGMA = 2.5e-3
TARGET = np.zeros(3)


def context(*, offset: float = 0.0, limits: bool = False, seed: int = 0) -> Context:
    bounds = load_robot("p3dx").operating if limits else None
    return Context(load_camera("hypercatadioptric"), bounds, offset, PERIOD, seed, True)


def make_scene(seed: int, count: int = 60) -> np.ndarray:
    rng = np.random.default_rng(seed)
    azimuth, reach = rng.uniform(-np.pi, np.pi, count), rng.uniform(2.0, 6.0, count)
    height = rng.uniform(-0.7, 1.5, count)
    return np.stack([reach * np.sin(azimuth), reach * np.cos(azimuth) - 0.7, height], axis=-1)


def rays(points: np.ndarray, pose: np.ndarray, rng, sigma: float) -> np.ndarray:
    s, c = np.sin(pose[2]), np.cos(pose[2])
    dx, dy = points[:, 0] - pose[0], points[:, 1] - pose[1]
    seen = np.stack([c * dx + s * dy, -s * dx + c * dy, points[:, 2]], axis=-1)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    seen += sigma * rng.normal(size=seen.shape)
    return seen / np.linalg.norm(seen, axis=1, keepdims=True)


@dataclass
class Drive:
    """A robot that starts at ``start`` and is moved by `step`; ``views`` is what it sees."""

    start: np.ndarray
    seed: int = 0
    sigma: float = 0.0
    count: int = 60
    offset: float = 0.0
    level: bool = False

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(1000 + self.seed)
        self.points = make_scene(self.seed, self.count)
        if self.level:
            self.points[:, 2] = 0.0
        self.pose = np.array(self.start, dtype=float)
        self.target = rays(self.points, TARGET, self.rng, self.sigma)
        self.initial = rays(self.points, self.pose, self.rng, self.sigma)
        self.time = 0.0

    def step(self, velocity: Velocity, dt: float = PERIOD) -> None:
        self.pose = step_exact(self.pose, *velocity, dt, self.offset)
        self.time += dt

    def views(self, outliers: int = 0, keep: slice = slice(None)) -> Views:
        current = rays(self.points, self.pose, self.rng, self.sigma)
        wrong = make_scene(self.seed + 77, outliers)
        current[:outliers] = rays(wrong, self.pose, self.rng, 0.0)
        return Views(
            ids=np.arange(self.count)[keep],
            target=self.target[keep],
            initial=self.initial[keep],
            current=current[keep],
            pixels=np.zeros((self.count, 2))[keep],
            sigma=max(self.sigma, 1e-4),
            stamp=self.time,
        )

    def nothing(self) -> Views:
        empty = np.empty((0, 3))
        return Views(
            ids=np.empty(0, dtype=np.int64),
            target=empty,
            initial=empty,
            current=empty,
            pixels=np.empty((0, 2)),
            sigma=SIGMA,
            stamp=self.time,
            health=Health.LOST,
            reason="dark",
        )
