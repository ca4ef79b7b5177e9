"""A small ray caster of a textured room: images of known truth, independent of the simulator.

Everything is a textured rectangle; a pixel's grey level is the texture at the first rectangle
that its ray meets, taken from the mip level that fits the pixel's footprint. Because the
renderer is a list of rays and planes, it also tells where any pixel's scene point is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Frame, Pose

Array = NDArray[np.float64]
CAMERA_HEIGHT_M = 0.8
# Textures are wider than any wall: where they repeated, wrong matches would be right ones.
_TEXELS, _WIDTH_M = 1024, 8.2
_LEVELS = 7


@dataclass(frozen=True)
class Rectangle:
    """A textured rectangle: ``origin + a·u + b·v`` with a, b in metres from 0 to the edges."""

    origin: Array
    along: Array
    up: Array
    size: tuple[float, float]
    texture: int


@cache
def _spectrum() -> NDArray[np.float32]:
    """Return the amplitudes of 1/f noise with periods from 2 cm to 80 cm.

    Finer detail would only alias.
    """
    f = np.hypot(np.fft.fftfreq(_TEXELS)[:, None], np.fft.rfftfreq(_TEXELS)[None]) * _TEXELS
    amplitude = np.maximum(f, 1.0) ** -1.1 * (f > 10) * np.exp(-((f / 400) ** 2))
    return np.asarray(amplitude, dtype=np.float32)


@cache
def texture(seed: int) -> list[NDArray[np.float32]]:
    """Return the mip levels (half an octave apart in blur) of 1/f noise, 8.2 m wide."""
    white = np.random.default_rng(seed).standard_normal((_TEXELS, _TEXELS), dtype=np.float32)
    base = np.fft.irfft2(np.fft.rfft2(white) * _spectrum())
    base = base / base.std()
    sharp = (128 + 48 * base).astype(np.float32)
    levels = [
        # The largest blur is 4 texels: a kernel of 25 holds three deviations of it.
        cv2.GaussianBlur(sharp, (25, 25) if level > 3 else (11, 11), 0.5 * 2 ** (level / 2))
        for level in range(_LEVELS)
    ]
    return [np.clip(level, 0, 255).astype(np.float32) for level in levels]


def wall(
    start: Sequence[float], end: Sequence[float], low: float, high: float, key: int
) -> Rectangle:
    """Return an upright rectangle over the floor line from ``start`` to ``end``."""
    a, b = np.array(start, float), np.array(end, float)
    along = (b - a) / np.linalg.norm(b - a)
    return Rectangle(
        np.array([a[0], a[1], low]),
        np.array([*along, 0.0]),
        np.array([0.0, 0.0, 1.0]),
        (float(np.linalg.norm(b - a)), high - low),
        key,
    )


def furnished_room() -> list[Rectangle]:
    """Return a 7 m by 8 m room with some boards standing in it, about a target at (0, 0)."""
    corners = [(-3.4, -4.6), (3.6, -4.6), (3.6, 3.4), (-3.4, 3.4)]
    walls = [wall(corners[i], corners[(i + 1) % 4], 0.0, 2.6, i) for i in range(4)]
    flat = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    floor = Rectangle(np.array([-3.4, -4.6, 0.0]), *flat, (7.0, 8.0), 4)
    ceiling = Rectangle(np.array([-3.4, -4.6, 2.6]), *flat, (7.0, 8.0), 5)
    boards = [
        wall((-2.2, 2.1), (-1.1, 2.6), 0.1, 1.7, 6),
        wall((1.0, 2.4), (2.2, 1.9), 0.1, 1.9, 7),
        wall((2.4, 0.4), (2.6, -0.9), 0.1, 1.6, 8),
        wall((-2.3, -1.5), (-2.5, 0.1), 0.1, 1.8, 9),
        wall((1.5, -2.8), (2.4, -2.3), 0.1, 1.7, 10),
    ]
    return [*walls, floor, ceiling, *boards]


class Room:
    """Renders frames of a list of rectangles through a central camera."""

    def __init__(self, camera: CentralCamera, scene: list[Rectangle] | None = None) -> None:
        self.camera = camera
        self.scene = furnished_room() if scene is None else scene
        grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
        rays, self._valid = camera.robot_rays(grid.astype(float))
        self._rays = rays[self._valid]
        # A pixel's footprint in radians, for the choice of the mip level.
        step, _ = camera.robot_rays(grid[self._valid] + np.array([1.0, 0.0]))
        angle = np.linalg.norm(np.cross(self._rays, step), axis=-1)
        self._footprint = np.nan_to_num(angle, nan=1e-2)
        self._textures = {r.texture: texture(r.texture) for r in self.scene}

    def cast(
        self, rays: Array, pose: Pose, scene: list[Rectangle] | None = None
    ) -> tuple[Array, Array, NDArray[np.intp], Array]:
        """Return (points in the world, ranges, rectangle numbers, texture coordinates)."""
        c, s = np.cos(pose.phi), np.sin(pose.phi)
        world = rays @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        eye = np.array([pose.x, pose.y, CAMERA_HEIGHT_M])
        best = np.full(len(rays), np.inf)
        which = np.full(len(rays), -1, dtype=np.intp)
        at = np.zeros((len(rays), 2))
        for number, r in enumerate(self.scene if scene is None else scene):
            normal = np.cross(r.along, r.up)
            with np.errstate(divide="ignore", invalid="ignore"):
                distance = ((r.origin - eye) @ normal) / (world @ normal)
            distance = np.where((distance > 1e-6) & (distance < best), distance, np.nan)
            offset = eye - r.origin
            a = offset @ r.along + distance * (world @ r.along)
            b = offset @ r.up + distance * (world @ r.up)
            hit = (a >= 0) & (a <= r.size[0]) & (b >= 0) & (b <= r.size[1])
            best[hit], which[hit] = distance[hit], number
            at[hit] = np.stack([a, b], axis=-1)[hit]
        return eye + world * best[:, None], best, which, at

    def frame(
        self,
        pose: Pose,
        sequence: int = 0,
        *,
        extra: Sequence[Rectangle] = (),
        gain: float = 1.0,
        noise: float = 0.0,
    ) -> Frame:
        """Return the image at a pose, with a gain and white noise (grey levels) if wanted."""
        scene = [*self.scene, *extra]
        for rectangle in extra:
            self._textures.setdefault(rectangle.texture, texture(rectangle.texture))
        _, distance, which, at = self.cast(self._rays, pose, scene)
        texels = at * (_TEXELS / _WIDTH_M)
        # Blur of half a pixel's footprint, in texels, as a (fractional) level.
        blur = 0.5 * distance * self._footprint * (_TEXELS / _WIDTH_M)
        level = np.clip(2 * np.log2(np.maximum(blur, 1e-3) / 0.5), 0, _LEVELS - 1.001)
        grey = np.zeros(len(distance), dtype=np.float32)
        for number, rectangle in enumerate(scene):
            mine = np.flatnonzero(which == number)
            if len(mine):
                levels = self._textures[rectangle.texture]
                grey[mine] = _sample(levels, texels[mine], level[mine])
        image = np.zeros((self.camera.height, self.camera.width), dtype=np.float32)
        image[self._valid] = grey * gain
        if noise:
            image += np.random.default_rng(sequence).normal(scale=noise, size=image.shape)
        pixels = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        return Frame(stamp=0.1 * sequence, sequence=sequence, image=pixels)

    def true_rays(self, target_rays: Array, pose: Pose) -> tuple[Array, NDArray[np.bool_]]:
        """Return where the scene points seen along rays from the target are seen from a pose.

        Also whether each is in plain view from there (not behind something else).
        """
        points, *_ = self.cast(target_rays, Pose(0.0, 0.0, 0.0))
        offset = points - np.array([pose.x, pose.y, CAMERA_HEIGHT_M])
        c, s = np.cos(pose.phi), np.sin(pose.phi)
        local = offset @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        distance = np.linalg.norm(local, axis=-1)
        rays = local / distance[:, None]
        _, first, *_ = self.cast(rays, pose)
        return rays, first > 0.99 * distance


def _sample(levels: list[NDArray[np.float32]], texels: Array, level: Array) -> NDArray[np.float32]:
    """Sample a mip pyramid trilinearly."""
    low = np.floor(level).astype(int)
    grey = np.zeros(len(level), dtype=np.float32)
    for number in np.unique(low):
        mine = np.flatnonzero(low == number)
        u, v = texels[mine].T.astype(np.float32)
        share = (level[mine] - number).astype(np.float32)
        grey[mine] = (1 - share) * _bilinear(levels[number], u, v)[: len(mine)]
        grey[mine] += share * _bilinear(levels[number + 1], u, v)[: len(mine)]
    return grey


def _bilinear(
    image: NDArray[np.float32], u: NDArray[np.float32], v: NDArray[np.float32]
) -> NDArray[np.float32]:
    # OpenCV wants pictures of less than 32767 rows, so the samples are folded.
    rows = -(-len(u) // 512)
    u, v = (np.resize(x, (rows, 512)) for x in (u, v))
    grey = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(grey, dtype=np.float32).ravel()
