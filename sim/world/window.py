"""PyBullet's own window: the scene's textures on the physics' plain boxes, and a point of view."""

from __future__ import annotations

from collections.abc import Iterable

from visctrl.hal.cameras.catalogue import load_camera
from visctrl.sim.render.drawn import DrawnScene, TextureFiles
from visctrl.sim.world.engine import pybullet
from visctrl.sim.world.scene import Scene

_VIEW = {"cameraDistance": 6.5, "cameraYaw": -90.0, "cameraPitch": -40.0}
_LOOK_AT = [-0.5, 0.0, 0.0]
_CLEAR = [0.0, 0.0, 0.0, 0.0]


def furnish_window(client: int, scene: Scene, solids: Iterable[int]) -> DrawnScene:
    """Show a scene in a physics client's window; ``solids`` are the bodies that it covers."""
    options = {"physicsClientId": client}
    pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0, **options)
    pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_SHADOWS, 0, **options)
    pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_RENDERING, 0, **options)
    for body in solids:
        pybullet.changeVisualShape(body, -1, rgbaColor=_CLEAR, **options)
    # The window filters textures itself; which camera they are meant for does not matter.
    drawn = DrawnScene(client, scene, load_camera("perspective"), TextureFiles.shared(), True)
    pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_RENDERING, 1, **options)
    pybullet.resetDebugVisualizerCamera(cameraTargetPosition=_LOOK_AT, **_VIEW, **options)
    return drawn
