"""A closed loop for tests: exact unicycle, features projected with pixel noise, real plugins."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from visctrl.contracts import Context, Controller, Estimator, Health, Views
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.models.unified import UnifiedCamera
from visctrl.hal.types import STANDSTILL
from visctrl.robots import Limits
from visctrl.robots.unicycle import step_exact, wrap_angle

PERSPECTIVE = UnifiedCamera(
    name="pinhole", width=640, height=480, xi=0.0, fx=600.0, fy=600.0, cx=319.5, cy=239.5
)
TS = 0.1


def omnidirectional(name: str) -> CentralCamera:
    return load_camera(name)


@dataclass
class World:
    """Points around the target that the target and the initial view both see."""

    start: tuple[float, float, float]
    camera: CentralCamera = PERSPECTIVE
    believed: CentralCamera | None = None
    noise_px: float = 0.0
    seed: int = 0
    count: int = 60
    outliers: float = 0.0

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng([self.seed, 7])
        self.believed = self.believed or self.camera
        self.points = self._points()
        self.target = self._look((0.0, 0.0, 0.0))
        self.initial = self._look(self.start)
        focal = abs(self.camera.fx)
        self.sigma = max(self.noise_px, 0.02) / focal

    def _points(self) -> np.ndarray:
        rng = np.random.default_rng([self.seed, 3])
        kept: list[np.ndarray] = []
        while sum(map(len, kept)) < self.count:
            if self.camera.panoramic:
                X = np.stack(
                    [rng.uniform(-12, 12, 500), rng.uniform(-20, 12, 500), rng.uniform(-2, 3, 500)],
                    -1,
                )
                X = X[np.abs(X[:, 2]) > 0.2]
            else:
                X = np.stack(
                    [rng.uniform(-5, 5, 500), rng.uniform(2, 12, 500), rng.uniform(-2.5, 2.5, 500)],
                    -1,
                )
            seen = self._project(X, (0.0, 0.0, 0.0))[1] & self._project(X, self.start)[1]
            kept.append(X[seen])
        return np.concatenate(kept)[: self.count]

    def _project(self, X: np.ndarray, pose) -> tuple[np.ndarray, np.ndarray]:
        x, y, phi = pose
        d = X - np.array([x, y, 0.0])
        c, s = math.cos(phi), math.sin(phi)
        rays = np.stack([c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1], d[:, 2]], -1)
        return self.camera.robot_pixels(rays)

    def _look(self, pose) -> tuple[np.ndarray, np.ndarray]:
        pixels, seen = self._project(self.points, pose)
        pixels = pixels + self.rng.normal(0.0, self.noise_px or 1e-12, pixels.shape)
        wrong = self.rng.random(len(pixels)) < self.outliers
        angle = self.rng.uniform(-np.pi, np.pi, len(pixels))
        off = self.rng.uniform(20.0, 80.0, len(pixels))[:, None]
        away = off * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        pixels[wrong] += away[wrong]
        return pixels, seen

    def views(self, pose, stamp: float) -> Views:
        pixels, seen = self._look(pose)
        ids = np.flatnonzero(seen)

        def rays(p):
            return self.believed.robot_rays(p[ids])[0]

        health = Health.OK if len(ids) >= 8 else Health.LOST
        return Views(
            ids.astype(np.int64),
            rays(self.target[0]),
            rays(self.initial[0]),
            rays(pixels),
            pixels[ids],
            self.sigma,
            stamp,
            health,
            "" if health is Health.OK else f"{len(ids)} features",
        )


@dataclass
class Run:
    poses: np.ndarray
    inputs: np.ndarray
    phases: list[str]
    finished: bool
    times: np.ndarray
    estimates: list = field(default_factory=list)

    @property
    def error(self) -> np.ndarray:
        """(x cm, y cm, φ deg) at the end."""
        x, y, phi = self.poses[-1]
        return np.array([100 * x, 100 * y, math.degrees(wrap_angle(phi))])

    @property
    def chatter(self) -> float:
        """Total variation of ω over the last quarter."""
        omega = self.inputs[3 * len(self.inputs) // 4 :, 1]
        return float(np.abs(np.diff(omega)).sum())


def context(camera: CentralCamera, seed: int = 0, limits: Limits | None = None) -> Context:
    return Context(camera, limits, 0.0, TS, seed, True)


def drive(world, estimator: Estimator, controller: Controller, duration: float) -> Run:
    pose = np.array(world.start, dtype=float)
    sent = STANDSTILL
    poses, inputs, phases, times, estimates = [pose.copy()], [], [], [], []
    estimator.reset()
    finished = False
    for k in range(round(duration / TS)):
        t = k * TS
        estimate = estimator.update(world.views(pose, t), sent, TS)
        decision = controller.update(estimate, sent, TS if k else 0.0)
        estimates.append(estimate)
        sent = decision.velocity
        assert sent.finite
        inputs.append(sent)
        phases.append(decision.phase)
        times.append(t)
        pose = step_exact(pose, sent.v, sent.omega, TS)
        poses.append(pose.copy())
        finished = decision.finished
        if finished:
            break
    return Run(np.array(poses), np.array(inputs), phases, finished, np.array(times), estimates)
