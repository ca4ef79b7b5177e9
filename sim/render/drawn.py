"""A scene's surfaces as bodies of a PyBullet client, textured for their distance."""

from __future__ import annotations

import math
import os
import tempfile
from functools import cache
from hashlib import blake2b
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Pose
from visctrl.sim.render.surfaces import Surface, surfaces
from visctrl.sim.render.textures import (
    BASE_DENSITY,
    FINEST_SIGMA_M,
    LEVELS,
    NEAREST_TEXEL_FINENESS,
    OBLIQUENESS,
    Levels,
    Pattern,
)
from visctrl.sim.world.engine import pybullet
from visctrl.sim.world.frames import TO_ENGINE, displacement, heading_matrix
from visctrl.sim.world.scene import Scene

Array = NDArray[np.float64]

#: Blur that a texture needs, in image pixels.
_SIGMA_PX = 0.7
#: A level is kept until another fits better by this much (octaves).
_HYSTERESIS = 0.6
_NEAREST_M = 0.3
_TYPICAL_HEIGHT_M = 0.75
#: Headings within which a camera that looks ahead is expected to stay (rad).
_TYPICAL_HEADING = math.radians(35.0)


class TextureFiles:
    """Texture images as files, made when first wanted and kept while the process lives.

    PyBullet remembers textures by file name, so a file's name must stand for its content.
    """

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="visctrl-textures-")
        self._made: dict[Pattern, Levels] = {}
        self._meshes = 0

    @staticmethod
    @cache
    def shared() -> TextureFiles:
        """Return this process's only instance."""
        return TextureFiles()

    def texture(self, pattern: Pattern, level: int, fineness: float) -> str:
        """Return the file that shows ``pattern`` at ``level`` (see `Levels.image`)."""
        content = blake2b(repr((pattern, level, fineness)).encode(), digest_size=12)
        path = Path(self._folder.name) / f"{content.hexdigest()}.bmp"
        if not path.exists():
            if pattern not in self._made:
                self._made[pattern] = Levels(pattern)
            # Complete or not there at all: a forked process may share the folder.
            draft = path.with_name(f"{os.getpid()}.bmp")
            cv2.imwrite(str(draft), self._made[pattern].image(level, fineness))
            draft.replace(path)
        return str(path)

    def forget(self) -> None:
        """Free the patterns that textures are made from; the files stay."""
        self._made.clear()

    def mesh(self, text: str) -> str:
        """Return a new file with a Wavefront mesh: two bodies of one file would share textures."""
        self._meshes += 1
        path = Path(self._folder.name) / f"{os.getpid()}-{self._meshes}.obj"
        path.write_text(text, encoding="ascii")
        return str(path)


class DrawnScene:
    """The bodies that show a scene.

    Parameters
    ----------
    client : int
        PyBullet client to build in.
    scene : Scene
        What to show.
    camera : CentralCamera
        Decides how fine textures are at a distance.
    files : TextureFiles
        Where texture images come from.
    mipmapped : bool
        The rasteriser filters textures itself: one fine texture serves every distance.
    """

    def __init__(
        self,
        client: int,
        scene: Scene,
        camera: CentralCamera,
        files: TextureFiles,
        mipmapped: bool,
    ) -> None:
        self._client = client
        self._camera = camera
        self._files = files
        self._mipmapped = mipmapped
        self._fineness = 1.0 if mipmapped else NEAREST_TEXEL_FINENESS
        self._polar = _seen_polar(camera)
        self._surfaces = surfaces(scene)
        self._items = {item.name: item for item in scene.items}
        self._textures: dict[tuple[int, int], int] = {}
        self._bodies = [self._build(surface) for surface in self._surfaces]
        # Nothing shown yet: any level is a change.
        self._levels = np.full(len(self._bodies), -LEVELS)
        self._centres = np.array([s.side.corners.mean(axis=0) for s in self._surfaces])
        self._normals = np.array([s.side.normal for s in self._surfaces])
        density = np.array([s.pattern.density for s in self._surfaces])
        self._finest = FINEST_SIGMA_M * BASE_DENSITY / density
        if mipmapped:
            for i in range(len(self._bodies)):
                self._show(i, 1)
        else:
            self._make_ready(scene)

    def prepare(self, pose: Pose, height_m: float) -> None:
        """Give every surface that faces the camera the texture its distance needs."""
        if self._mipmapped:
            return
        exact, facing = self._exact_levels(np.array([pose.x, pose.y, height_m]), pose.phi)
        stale = facing & (np.abs(exact - self._levels) > _HYSTERESIS)
        for i in np.flatnonzero(stale):
            self._show(int(i), round(exact[i]))

    def place(self, item: str, at: Pose) -> None:
        """Move an item's bodies so that it stands at ``at`` (x, y, yaw)."""
        home = self._items[item]
        start = Pose(*home.at_m, math.radians(home.yaw_deg))
        R, shift = displacement(start, at)
        where = TO_ENGINE @ shift
        spin = pybullet.getQuaternionFromEuler([0.0, 0.0, at.phi - start.phi])
        for i, surface in enumerate(self._surfaces):
            if surface.item != item:
                continue
            pybullet.resetBasePositionAndOrientation(
                self._bodies[i], where.tolist(), spin, physicsClientId=self._client
            )
            side = surface.side
            self._centres[i] = R @ side.corners.mean(axis=0) + shift
            self._normals[i] = R @ side.normal

    def _build(self, surface: Surface) -> int:
        shape = pybullet.createVisualShape(
            pybullet.GEOM_MESH,
            fileName=self._files.mesh(surface.obj(TO_ENGINE)),
            physicsClientId=self._client,
        )
        return int(
            pybullet.createMultiBody(baseVisualShapeIndex=shape, physicsClientId=self._client)
        )

    def _show(self, index: int, level: int) -> None:
        pybullet.changeVisualShape(
            self._bodies[index],
            -1,
            textureUniqueId=self._texture(index, level),
            physicsClientId=self._client,
        )
        self._levels[index] = level

    def _texture(self, index: int, level: int) -> int:
        key = (index, level)
        if key not in self._textures:
            self._textures[key] = pybullet.loadTexture(
                self._file(index, level), physicsClientId=self._client
            )
        return self._textures[key]

    def _file(self, index: int, level: int) -> str:
        return self._files.texture(self._surfaces[index].pattern, level, self._fineness)

    def _make_ready(self, scene: Scene) -> None:
        """Make the texture files that the arena needs, so that driving there is not held up."""
        for x in np.linspace(*scene.arena.x_m, 3):
            for y in np.linspace(*scene.arena.y_m, 4):
                eye = np.array([x, y, _TYPICAL_HEIGHT_M])
                exact, facing = self._exact_levels(eye, 0.0)
                for i in np.flatnonzero(facing & self._may_be_seen(eye)):
                    self._file(int(i), round(exact[i]))
        self._files.forget()

    def _may_be_seen(self, eye: Array) -> NDArray[np.bool_]:
        """Return which surfaces a robot that drives towards the target may have in view."""
        if self._camera.panoramic:
            return np.ones(len(self._centres), dtype=bool)
        towards = self._centres - eye
        bearing = np.abs(np.arctan2(towards[:, 0], towards[:, 1]))
        return np.asarray(bearing < self._polar[1] + _TYPICAL_HEADING)

    def _exact_levels(self, eye: Array, phi: float) -> tuple[Array, NDArray[np.bool_]]:
        """Return the (fractional) level that each surface needs, and whether it faces the eye."""
        towards = self._centres - eye
        distance = np.maximum(np.linalg.norm(towards, axis=-1), _NEAREST_M)
        cosine = -np.sum(towards * self._normals, axis=-1) / distance
        facing = cosine > 0.0
        footprint = distance / self._pixels_per_radian(towards, phi)
        footprint = footprint / np.clip(cosine, 0.1, 1.0) ** OBLIQUENESS
        level = np.log2(_SIGMA_PX * footprint / self._finest)
        return np.clip(level, 0.0, LEVELS - 1.0), facing

    def _pixels_per_radian(self, towards: Array, phi: float) -> Array:
        """Return the camera's resolution towards each surface, at the nearest ray it sees."""
        rays = towards @ heading_matrix(phi) @ self._camera.rotation
        polar = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
        seen = np.clip(polar, *self._polar)
        rays = np.stack([np.sin(seen), np.zeros_like(seen), np.cos(seen)], axis=-1)
        J = self._camera.jacobian(rays)
        area = np.sqrt(np.linalg.det(J @ np.swapaxes(J, -1, -2)))
        return np.asarray(np.sqrt(area), dtype=np.float64)


def _seen_polar(camera: CentralCamera) -> tuple[float, float]:
    """Return the least and largest angle (rad) from the optical axis in a camera's image."""
    v, u = np.mgrid[0 : camera.height : 8, 0 : camera.width : 8].astype(np.float64)
    rays, valid = camera.unproject(np.stack([u, v], axis=-1))
    polar = np.arccos(np.clip(rays[valid][:, 2], -1.0, 1.0))
    return float(polar.min()), float(polar.max())
