"""What many robots see: the mock's images and perception ``features``, in arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.mock.backend import MockOptions, Purpose
from visctrl.montecarlo.planar_fit import median
from visctrl.montecarlo.robots import Array, Mask, Parts, Robots
from visctrl.perception.features import FeaturesOptions
from visctrl.runtime.plan import Plan

#: Images whose noise is drawn at once.
_AHEAD = 32


class View(NamedTuple):
    """One image of every robot.

    right, forward, up : (R, N), of unit rays in the robots' frames; straight ahead where a
        feature is not seen.
    seen : (R, N), 1 where a feature is seen, else 0.
    """

    right: Array
    forward: Array
    up: Array
    seen: Array

    @property
    def parts(self) -> Parts:
        """The rays, part by part."""
        return self.right, self.forward, self.up

    @property
    def rays(self) -> Array:
        """The rays (R, N, 3)."""
        return np.stack(self.parts, axis=2)


class Eyes(Robots):
    """The cameras of R robots of one plan, each in a scene of its own.

    Parameters
    ----------
    plan : Plan
        Of the mock; its start and seed are not used.
    scenes : (R, N, 3) array
        Points in the target's frame (m).
    seeds : sequence of int
        Of the robots' noise.
    """

    def __init__(self, plan: Plan, scenes: Array, seeds: Sequence[int]) -> None:
        options, perception = plan.backend_options, plan.perception.options
        assert isinstance(options, MockOptions)
        assert isinstance(perception, FeaturesOptions)
        self._camera, self._true_camera = plan.camera, plan.true_camera
        self._noise_px, self._assumed_px = options.noise_px, perception.noise_px
        self._frames, self._seeds = plan.scenario.target.frames, np.array(seeds)
        self._points = tuple(np.ascontiguousarray(part) for part in np.moveaxis(scenes, 2, 0))
        self._rngs = _objects([Purpose.NOISE.generator(seed) for seed in seeds])
        # Noise (R, images, 2, N) of images to come, and how many of them have been taken.
        ahead = _AHEAD if self._noise_px > 0.0 else 0
        self._noise = np.empty((len(scenes), ahead, 2, self.features))
        self._taken = np.full(len(scenes), ahead)
        self._closed = np.zeros(len(scenes), dtype=np.bool_)

    @property
    def features(self) -> int:
        """How many features each scene has."""
        return int(self._points[0].shape[1])

    def look(self, poses: Array) -> View:
        """Return what is seen from poses (R, 3) now."""
        u, v, seen = self._image(poses)
        if self._noise_px > 0.0:
            noise = self._next_noise()
            u, v = u + noise[:, 0], v + noise[:, 1]
        return _view(self._camera, u, v, seen)

    def target(self) -> tuple[View, Array]:
        """Return the view from the target, and the standard deviation (R,) of a bearing (rad)."""
        u, v, seen = self._image(np.zeros((len(self._seeds), 3)))
        if self._noise_px > 0.0:
            size = (self._frames, self.features, 2)
            for robot, seed in enumerate(self._seeds.tolist()):
                noise = Purpose.TEACHING.generator(seed).normal(scale=self._noise_px, size=size)
                u[robot] += noise[..., 0].mean(axis=0)
                v[robot] += noise[..., 1].mean(axis=0)
        view = _view(self._camera, u, v, seen)
        turns = median(self._camera.bearing_per_pixel(view.rays), view.seen)
        return view, self._assumed_px * turns

    def close(self, which: Mask) -> None:
        """Let some draw no noise any more: somebody else goes on with their generators."""
        self._closed = self._closed | which

    def _image(self, poses: Array) -> tuple[Array, Array, Mask]:
        """Return the features' pixels u and v, and which are in the image, each (R, N)."""
        x, y, phi = poses.T[:, :, None]
        s, c = np.sin(phi), np.cos(phi)
        dx, dy = self._points[0] - x, self._points[1] - y
        return pixels_of(self._true_camera, (c * dx + s * dy, c * dy - s * dx, self._points[2]))

    def _next_noise(self) -> Array:
        """Return the noise (R, 2, N) of the next image, each robot's from its own generator."""
        self._taken[self._closed] = 0
        for robot in np.flatnonzero(self._taken == _AHEAD).tolist():
            rng: np.random.Generator = self._rngs[robot]
            drawn = rng.normal(scale=self._noise_px, size=(_AHEAD, self.features, 2))
            self._noise[robot] = drawn.swapaxes(1, 2)
            self._taken[robot] = 0
        noise = self._noise[np.arange(len(self._taken)), self._taken]
        self._taken = self._taken + 1
        return np.asarray(noise)


def pixels_of(camera: CentralCamera, rays: Parts) -> tuple[Array, Array, Mask]:
    """Return u, v and validity of robot rays: `CentralCamera.robot_pixels`, part by part."""
    x, y, z = _turned(camera.rotation.T, rays)
    norm = np.sqrt(x * x + y * y + z * z)
    inside = _in_field(camera, z / norm)
    depth = z + camera.xi * norm
    scale = 1.0 / (depth if inside.all() else np.where(inside, depth, np.nan))
    y = y * scale
    u = camera.fx * (x * scale) + camera.cx
    if camera.skew != 0.0:
        u += camera.skew * y
    v = camera.fy * y + camera.cy
    return u, v, inside & _contains(camera, u, v)


def rays_of(camera: CentralCamera, u: Array, v: Array) -> tuple[Parts, Mask]:
    """Return unit robot rays and validity of pixels: `CentralCamera.robot_rays`, part by part."""
    y = (v - camera.cy) * (1.0 / camera.fy)
    x = (u - camera.cx) * (1.0 / camera.fx)
    if camera.skew != 0.0:
        x -= camera.skew / camera.fx * y
    r2 = x * x + y * y
    root = 1.0 + (1.0 - camera.xi**2) * r2
    if camera.xi > 1.0:
        root = np.where(root >= 0.0, root, np.nan)
    factor = (camera.xi + np.sqrt(root)) / (1.0 + r2)
    z = factor - camera.xi
    valid = _in_field(camera, z) & _contains(camera, u, v)
    return _turned(camera.rotation, (factor * x, factor * y, z)), valid


def _view(camera: CentralCamera, u: Array, v: Array, seen: Mask) -> View:
    (right, forward, up), valid = rays_of(camera, u, v)
    seen = seen & valid
    if not seen.all():
        right, up = np.where(seen, right, 0.0), np.where(seen, up, 0.0)
        forward = np.where(seen, forward, 1.0)
    return View(right, forward, up, seen.astype(np.float64))


def _in_field(camera: CentralCamera, z: Array) -> Mask:
    low, high = camera.field
    return np.asarray(z >= low if high >= 1.0 else (z >= low) & (z <= high))


def _contains(camera: CentralCamera, u: Array, v: Array) -> Mask:
    inside = (u >= -0.5) & (u <= camera.width - 0.5)
    return np.asarray(inside & (v >= -0.5) & (v <= camera.height - 0.5))


def _turned(rotation: Array, parts: Parts) -> Parts:
    """Return ``rotation`` (3, 3) times vectors; of an upright camera most of it is 0."""
    turned = []
    for row in rotation.tolist():
        terms = [
            part if k == 1.0 else k * part for k, part in zip(row, parts, strict=True) if k != 0.0
        ]
        total = terms[0]
        for term in terms[1:]:
            total = total + term
        turned.append(total)
    return turned[0], turned[1], turned[2]


def _objects(things: Sequence[object]) -> NDArray[Any]:
    """Return things as an array, so that it goes with the robots."""
    array = np.empty(len(things), dtype=np.object_)
    array[:] = things
    return array
