"""What many robots see: the mock's images and perception ``features``, in arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.central_camera import CentralCamera
from hal.mock import MockOptions, Purpose
from visctrl.montecarlo.planar import median
from visctrl.montecarlo.robots import Array, Mask, Robots
from visctrl.perception.features import FeaturesOptions
from visctrl.runtime.plan import Plan

#: Images whose noise is drawn at once.
_AHEAD = 32
_FORWARD = (0.0, 1.0, 0.0)


class View(NamedTuple):
    """One image of every robot.

    rays : (R, N, 3) unit rays in the robots' frames; forward where a feature is not seen.
    seen : (R, N), 1 where a feature is seen, else 0.
    """

    rays: Array
    seen: Array


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
        self._frames = plan.scenario.target.frames
        self._points, self._seeds = scenes, np.array(seeds)
        self._rngs: NDArray[Any] = _objects([Purpose.NOISE.generator(seed) for seed in seeds])
        # Noise of images to come, and how many of them have been taken.
        ahead = _AHEAD if self._noise_px > 0.0 else 0
        self._noise = np.empty((len(scenes), ahead, *scenes.shape[1:2], 2))
        self._taken = np.full(len(scenes), ahead)
        self._closed = np.zeros(len(scenes), dtype=np.bool_)

    @property
    def features(self) -> int:
        """How many features each scene has."""
        return int(self._points.shape[1])

    def look(self, poses: Array) -> View:
        """Return what is seen from poses (R, 3) now."""
        pixels, seen = self._image(poses)
        if self._noise_px > 0.0:
            pixels += self._next_noise()
        return _view(self._camera, pixels, seen)

    def target(self) -> tuple[View, Array]:
        """Return the view from the target, and the standard deviation (R,) of a bearing (rad)."""
        pixels, seen = self._image(np.zeros((len(self._points), 3)))
        if self._noise_px > 0.0:
            for robot, seed in enumerate(self._seeds.tolist()):
                rng = Purpose.TEACHING.generator(seed)
                size = (self._frames, *pixels.shape[1:])
                pixels[robot] += rng.normal(scale=self._noise_px, size=size).mean(axis=0)
        view = _view(self._camera, pixels, seen)
        turns = median(self._camera.bearing_per_pixel(view.rays), view.seen)
        return view, self._assumed_px * turns

    def close(self, which: Mask) -> None:
        """Let some draw no noise any more: somebody else goes on with their generators."""
        self._closed = self._closed | which

    def _image(self, poses: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return the features' pixels (R, N, 2), and which are in the image."""
        x, y, phi = poses.T[:, :, None]
        s, c = np.sin(phi), np.cos(phi)
        rays = np.empty_like(self._points)
        dx, dy = self._points[..., 0] - x, self._points[..., 1] - y
        rays[..., 0], rays[..., 1] = c * dx + s * dy, c * dy - s * dx
        rays[..., 2] = self._points[..., 2]
        return self._true_camera.robot_pixels(rays)

    def _next_noise(self) -> Array:
        """Return the noise (R, N, 2) of the next image, each robot's from its own generator."""
        self._taken[self._closed] = 0
        for robot in np.flatnonzero(self._taken == _AHEAD).tolist():
            rng: np.random.Generator = self._rngs[robot]
            self._noise[robot] = rng.normal(scale=self._noise_px, size=self._noise.shape[1:])
            self._taken[robot] = 0
        noise = self._noise[np.arange(len(self._taken)), self._taken]
        self._taken = self._taken + 1
        return np.asarray(noise)


def _view(camera: CentralCamera, pixels: Array, seen: NDArray[np.bool_]) -> View:
    rays, valid = camera.robot_rays(pixels)
    seen = seen & valid
    if not seen.all():
        rays = np.where(seen[..., None], rays, _FORWARD)
    return View(rays, seen.astype(np.float64))


def _objects(things: Sequence[object]) -> NDArray[Any]:
    """Return things as an array, so that it goes with the robots."""
    array = np.empty(len(things), dtype=np.object_)
    array[:] = things
    return array
