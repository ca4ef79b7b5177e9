"""A robot among points: exact unicycle, an omnidirectional camera, pixel noise. No images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Context, Health, Views
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Velocity
from visctrl.robots.unicycle import step_exact

Array = NDArray[np.float64]

CAMERA = load_camera("hypercatadioptric").resized(1024, 768)
HEIGHT = 0.8


class World:
    """One robot in a fresh scene; everything random comes from ``seed``.

    ``camera`` makes the images, ``believed`` turns them into rays. ``noise`` is the standard
    deviation of what is really executed about what is commanded, (m/s, rad/s) every tick.
    """

    def __init__(
        self,
        start: tuple[float, float, float],
        seed: int,
        *,
        count: int = 20,
        noise_px: float = 1.0,
        target_frames: int = 1,
        camera: CentralCamera = CAMERA,
        believed: CentralCamera = CAMERA,
        offset: float = 0.08,
        noise: tuple[float, float] = (0.0, 0.0),
        gain: float = 1.0,
    ) -> None:
        self.rng = np.random.default_rng(seed)
        self.pose = np.array([start[0], start[1], np.radians(start[2])])
        self.offset, self.noise, self.noise_px, self.gain = offset, noise, noise_px, gain
        self.camera, self.believed = camera, believed
        self.time = 0.0
        self.believed_noise_px = noise_px
        self.points = self._scene(count)
        target = [self._see(np.zeros(3)) for _ in range(target_frames)]
        self._target = np.mean(target, axis=0)
        self._target_frames = target_frames
        self._initial = self._see(self.pose)

    def _scene(self, count: int) -> Array:
        """Draw points that both the target and the start see."""
        x, y, _ = self.pose
        low = np.array([min(x, 0.0) - 5.0, min(y, 0.0) - 5.0, 0.0])
        high = np.array([max(x, 0.0) + 5.0, max(y, 0.0) + 5.0, 3.0])
        chosen = np.empty((0, 3))
        while len(chosen) < count:
            points = self.rng.uniform(low, high, (20 * count, 3))
            seen = np.isfinite(self._pixels(np.zeros(3), points)[:, 0])
            seen &= np.isfinite(self._pixels(self.pose, points)[:, 0])
            chosen = np.vstack([chosen, points[seen]])
        return chosen[:count]

    def _pixels(self, pose: Array, points: Array) -> Array:
        d = points - [pose[0], pose[1], HEIGHT]
        s, c = np.sin(pose[2]), np.cos(pose[2])
        rays = np.stack([c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1], d[:, 2]], -1)
        return self.camera.robot_pixels(rays)[0]

    def _see(self, pose: Array) -> Array:
        pixels = self._pixels(pose, self.points)
        return pixels + self.rng.normal(0.0, self.noise_px, pixels.shape)

    def drive(self, velocity: Velocity, dt: float) -> None:
        """Execute a velocity for ``dt`` seconds."""
        v, omega = np.array(velocity) + self.rng.normal(0.0, self.noise)
        if velocity == Velocity(0.0, 0.0):
            v = omega = 0.0
        self.pose = step_exact(self.pose, self.gain * v, omega, dt, self.offset)
        self.time += dt

    def views(self, *, blind: bool = False) -> Views:
        """Return what the robot sees now."""
        current = self._see(self.pose)
        rays = [self.believed.robot_rays(p)[0] for p in (self._target, self._initial, current)]
        seen = np.isfinite(np.sum(rays, axis=(0, 2))) & (not blind)
        sigma_px = max(self.believed_noise_px, 1e-4)
        images = np.stack([self._target, self._initial, current])[:, seen]
        # About an upright axis a bearing is an angle about the image's centre.
        sigmas = sigma_px / np.linalg.norm(images - [self.believed.cx, self.believed.cy], axis=-1)
        sigmas[0] /= np.sqrt(self._target_frames)
        return Views(
            ids=np.flatnonzero(seen).astype(np.int64),
            target=rays[0][seen],
            initial=rays[1][seen],
            current=rays[2][seen],
            pixels=current[seen],
            sigma=float(np.median(sigmas)) if seen.any() else sigma_px,
            stamp=self.time,
            health=Health.OK if seen.any() else Health.LOST,
            reason="" if seen.any() else "no features",
            sigmas=lambda: sigmas,
        )

    def context(self, period: float, seed: int = 0) -> Context:
        """Return what plugins are told about this robot."""
        return Context(self.believed, None, self.offset, period, seed, lockstep=True)
