"""PyBullet's EGL renderer: whether it works here, and loading it.

Where it does not work the plugin ends the whole process, so it is tried in another one first.
"""

from __future__ import annotations

import subprocess
import sys
from functools import cache

import pybullet

_PLUGIN = "eglRendererPlugin"
_PROBE_TIMEOUT_S = 20.0
#: A white triangle's pixel on the background: proves that something is really drawn.
_PROBE = """
import importlib.util, pybullet as p, sys
client = p.connect(p.DIRECT)
spec = importlib.util.find_spec("eglRenderer")
plugin = p.loadPlugin(spec.origin, "_" + "{plugin}") if spec else p.loadPlugin("{plugin}")
if plugin < 0:
    sys.exit(1)
shape = p.createVisualShape(p.GEOM_BOX, halfExtents=[0.5] * 3, rgbaColor=[1, 0, 0, 1])
p.createMultiBody(baseVisualShapeIndex=shape, basePosition=[3, 0, 0])
view = p.computeViewMatrix([0, 0, 0], [1, 0, 0], [0, 0, 1])
projection = p.computeProjectionMatrixFOV(60, 1, 0.1, 10)
image = p.getCameraImage(64, 64, view, projection, shadow=0,
                         renderer=p.ER_BULLET_HARDWARE_OPENGL)[2]
inside, outside = image[32][32], image[2][2]
print("drawn" if inside[0] > 2 * int(inside[2]) and outside[2] > 100 else "blank")
"""


class EglPlugin:
    """The plugin, loaded into a client; only after `egl_usable` has said yes."""

    def __init__(self, client: int) -> None:
        self._client = client
        self._number = _load(client)

    def unload(self) -> None:
        """Take the plugin out of its client."""
        pybullet.unloadPlugin(self._number, physicsClientId=self._client)


@cache
def egl_usable() -> bool:
    """Return whether the plugin draws on this machine; tried once, in another process."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE.format(plugin=_PLUGIN)],
            capture_output=True,
            text=True,
            timeout=_PROBE_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0 and "drawn" in done.stdout


def _load(client: int) -> int:
    from importlib.util import find_spec

    spec = find_spec("eglRenderer")
    if spec is not None and spec.origin is not None:
        return int(pybullet.loadPlugin(spec.origin, f"_{_PLUGIN}", physicsClientId=client))
    return int(pybullet.loadPlugin(_PLUGIN, physicsClientId=client))
