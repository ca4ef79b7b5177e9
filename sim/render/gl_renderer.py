"""Pictures by ray casting in an OpenGL fragment shader.

Every pixel's own ray is followed to the nearest of the rectangles that its tile of the image may
show: nothing is drawn in perspective first and put together afterwards, so there are no seams, and
a mirror costs what a flat view costs. On a processor, Mesa compiles the shader to vector code.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Pose
from visctrl.sim.render.gl_pass import RayPass
from visctrl.sim.render.raycast import RectangleSet, Seen, cut_tiles
from visctrl.sim.render.renderer import Image, Renderer
from visctrl.sim.render.texture_sheet import Shown, shown
from visctrl.sim.world.frames import displacement, heading_matrix
from visctrl.sim.world.scene import Scene

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: Side of the image's tiles (px).
_TILE = 16


class GlRenderer(Renderer):
    """Draws with OpenGL 3.3, on a graphics card or in software.

    Parameters
    ----------
    scene : Scene
        What is there.
    camera : CentralCamera
        What the image is made with.
    detail : float
        Rays per pixel, along a line: the nearest whole number, at least 1.
    floor : bool
        Draw the textures of floor and ceiling.

    Raises
    ------
    InputError
        See `RayPass`.
    """

    def __init__(
        self, scene: Scene, camera: CentralCamera, detail: float = 1.0, floor: bool = True
    ) -> None:
        self.camera = camera
        world = shown(scene, floor)
        self._rectangles = RectangleSet(world.rectangles)
        self._homes = {
            item.name: Pose(*item.at_m, math.radians(item.yaw_deg)) for item in scene.items
        }
        self._items = np.array(world.items)
        self._density = _texels_per_metre(world)
        self._fine = max(1, round(detail))
        rays, spans = _fine_rays(camera, self._fine)
        self._tiles = cut_tiles(rays, spans > 0.0, _TILE)
        lit = np.concatenate([rays, spans[..., None]], axis=-1)
        self._pass = RayPass(lit, self._tiles, world.sheet)

    def render(self, pose: Pose, height_m: float) -> Image:
        """See `Renderer.render`."""
        eye = np.array([pose.x, pose.y, height_m])
        seen = self._rectangles.seen_from(eye, heading_matrix(pose.phi) @ self.camera.rotation)
        found = self._tiles.candidates(seen)
        image = self._pass.draw(found, self._hits(seen)[found.which])
        if self._fine == 1:
            return image
        size = (self.camera.width, self.camera.height)
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)

    def place(self, item: str, at: Pose) -> None:
        """See `Renderer.place`."""
        which = np.flatnonzero(self._items == item)
        self._rectangles.move(which, *displacement(self._homes[item], at))

    def close(self) -> None:
        """See `Renderer.close`."""
        self._pass.close()

    def _hits(self, seen: Seen) -> Single:
        """Return what the shader needs to know of rectangles (see `RayPass.draw`)."""
        beside = np.stack([seen.distance, self._density[seen.numbers], seen.numbers], axis=-1)
        return np.concatenate([seen.maps, beside[..., None]], axis=-1).astype(np.float32)


def _texels_per_metre(world: Shown) -> Array:
    """Return the resolution (N,) of the rectangles' textures, the mean of both directions."""
    area = [np.linalg.norm(np.cross(r.right, r.up)) for r in world.rectangles]
    texels = [place.width * place.height for place in world.sheet.places]
    return np.sqrt(np.array(texels) / np.array(area))


def _fine_rays(camera: CentralCamera, fine: int) -> tuple[Array, Array]:
    """Return ``fine``² unit rays per pixel in camera axes, and the angle that each spans (rad).

    (fine H, fine W, 3) and (fine H, fine W); 0 and 0 where the camera shows nothing.
    """
    u, v = ((np.arange(fine * n) + 0.5) / fine - 0.5 for n in (camera.width, camera.height))
    rays, _ = camera.unproject(np.stack(np.meshgrid(u, v), axis=-1))
    whole = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    shown_pixels = camera.unproject(whole)[1].repeat(fine, axis=0).repeat(fine, axis=1)
    # Where a pixel shows something, all of its rays count, up to the model's own limit.
    usable = shown_pixels & np.isfinite(rays).all(axis=-1)
    rays = np.where(usable[..., None], rays, 0.0)
    spans = np.zeros(usable.shape)
    J = camera.jacobian(rays[usable])
    spans[usable] = np.linalg.det(J @ np.swapaxes(J, -1, -2)) ** -0.25 / fine
    return rays, spans
