"""Pictures of a scene through a central camera.

`Renderer` is the interface; `BulletRenderer` draws the faces of a `FaceLayout` with PyBullet's
software renderer or its EGL plugin, in a physics client of its own that holds nothing but the
scene. `visctrl.sim.render.gl_renderer` casts rays instead;
`visctrl.sim.render.renderer_choice` chooses.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Pose
from visctrl.sim.render.drawn import DrawnScene, TextureFiles
from visctrl.sim.render.ground import Backdrop
from visctrl.sim.render.view_atlas import Face, PixelOrigin, plan_faces
from visctrl.sim.world.engine import connect, disconnect, pybullet
from visctrl.sim.world.frames import TO_ENGINE, heading_matrix
from visctrl.sim.world.scene import Scene

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

#: Where the first pixel of PyBullet's rasteriser samples (measured with known points).
PIXEL_ORIGIN = PixelOrigin(0.0, 1.0)
_NEAR_M, _FAR_M = 0.05, 60.0
#: Depth buffer value beyond which nothing has been drawn.
_EMPTY_DEPTH = 0.99999


class Renderer(ABC):
    """Draws what a camera at a planar pose sees."""

    @abstractmethod
    def render(self, pose: Pose, height_m: float) -> Image:
        """Return the image (H, W), grey, of the camera at ``pose``, ``height_m`` above ground.

        The image is free of noise; pixels outside the camera's field of view are 0.
        """

    @abstractmethod
    def place(self, item: str, at: Pose) -> None:
        """Move an item of the scene to another place (x, y, φ = its yaw)."""

    @abstractmethod
    def close(self) -> None:
        """Release the renderer's resources. Safe to call twice."""


class BulletRenderer(Renderer):
    """Draws with PyBullet's software rasteriser, TinyRenderer.

    Parameters
    ----------
    scene : Scene
        What is there.
    camera : CentralCamera
        What the image is made with.
    detail : float
        Face pixels per image pixel (see `plan_faces`).
    floor : bool
        Draw the textures of floor and ceiling.
    """

    def __init__(
        self,
        scene: Scene,
        camera: CentralCamera,
        detail: float = 1.0,
        floor: bool = True,
    ) -> None:
        self.camera = camera
        self.layout = plan_faces(camera, PIXEL_ORIGIN, detail)
        self._client = connect()
        self._drawn = DrawnScene(
            self._client, scene, camera, TextureFiles.shared(), mipmapped=False
        )
        self._backdrop = Backdrop(scene, camera, self.layout, PIXEL_ORIGIN, floor)
        self._atlas = np.zeros(self.layout.size, np.uint8)
        self._projections = [_projection(face) for face in self.layout.faces]

    def render(self, pose: Pose, height_m: float) -> Image:
        """See `Renderer.render`."""
        centre = np.array([pose.x, pose.y, height_m])
        rotation = heading_matrix(pose.phi) @ self.camera.rotation
        self._drawn.prepare(pose, height_m)
        for i, face in enumerate(self.layout.faces):
            colour, depth = self._picture(i, centre, rotation @ face.rotation)
            place = self._atlas[face.row : face.row + face.height, : face.width]
            cv2.cvtColor(colour, cv2.COLOR_RGBA2GRAY, dst=place)
            self._backdrop.fill(i, place, depth > _EMPTY_DEPTH, pose, height_m)
        image = self.layout.compose(self._atlas)
        image[self.layout.outside] = 0
        return image

    def place(self, item: str, at: Pose) -> None:
        """See `Renderer.place`."""
        self._drawn.place(item, at)

    def close(self) -> None:
        """See `Renderer.close`."""
        if self._client >= 0:
            disconnect(self._client)
            self._client = -1

    def _picture(self, index: int, centre: Array, eye: Array) -> tuple[Image, NDArray[np.float32]]:
        face = self.layout.faces[index]
        turn = (TO_ENGINE @ eye).T
        view = np.eye(4)
        view[:3, :3] = turn
        view[:3, 3] = -turn @ (TO_ENGINE @ centre)
        _, _, colour, depth, _ = pybullet.getCameraImage(
            face.width,
            face.height,
            view.T.ravel().tolist(),
            self._projections[index],
            # These stay set in the client once given, so all are given.
            shadow=0,
            lightAmbientCoeff=1.0,
            lightDiffuseCoeff=0.0,
            lightSpecularCoeff=0.0,
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self._client,
        )
        return colour, depth


def _projection(face: Face) -> list[float]:
    sides = (face.left, face.right, face.bottom, face.top)
    matrix = pybullet.computeProjectionMatrix(*(s * _NEAR_M for s in sides), _NEAR_M, _FAR_M)
    return list(matrix)
