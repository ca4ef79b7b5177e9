"""The emulated robot's camera: pictures of a scene from its pose, streamed over HTTP.

It runs in a process of its own, as a camera does: drawing must not delay the robot's firmware.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import time
from dataclasses import dataclass
from enum import IntEnum
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import Synchronized, SynchronizedArray
from types import TracebackType
from typing import Self

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.emulator.stream import MjpegServer
from visctrl.hal.errors import CameraError
from visctrl.hal.types import Pose
from visctrl.robots.errors import VisctrlError
from visctrl.robots.model import Mount
from visctrl.robots.unicycle import step_exact
from visctrl.sim.options import RendererName

_START_S = 120.0
_JOIN_S = 3.0
_JPEG_QUALITY = 95


class State(IntEnum):
    """What the camera does."""

    WORKING = 0
    #: The connection stays, nothing is sent any more.
    FROZEN = 1
    #: The connection is cut, new ones are refused.
    DROPPED = 2


@dataclass(frozen=True)
class CameraSpec:
    """What to stream.

    scene : its name, or its file. camera : what the pictures are made with. mount : where it
    sits. renderer : as in `visctrl.sim.options.SimOptions`. image_noise : grey levels (standard
    deviation). fps : pictures per second. port : TCP port on loopback, 0 for a free one.
    """

    scene: str
    camera: CentralCamera
    mount: Mount
    renderer: RendererName | None = None
    image_noise: float = 2.0
    fps: float = 10.0
    port: int = 0
    seed: int = 0


class EmulatedCamera:
    """A camera process, as a context manager.

    Parameters
    ----------
    spec : CameraSpec
        What to stream.
    axle : Pose
        Where the robot stands; `move` tells the camera when that changes.
    """

    def __init__(self, spec: CameraSpec, axle: Pose) -> None:
        context = multiprocessing.get_context("spawn")
        self._axle: SynchronizedArray[float] = context.Array("d", list(axle))
        self._state: Synchronized[int] = context.Value("i", State.WORKING)
        self._ours, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(spec, self._axle, self._state, theirs), daemon=True
        )
        self._theirs = theirs
        self.url = ""

    def __enter__(self) -> Self:
        """Start the process and wait until it streams.

        Raises
        ------
        CameraError, InputError
            It cannot, and says why.
        """
        self._process.start()
        self._theirs.close()
        answer: str | VisctrlError | None = None
        with contextlib.suppress(EOFError):
            answer = self._ours.recv() if self._ours.poll(_START_S) else None
        if isinstance(answer, str):
            self.url = answer
            return self
        self.close()
        raise answer or CameraError("the emulated camera's process has failed to start")

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the process."""
        self._ours.close()
        self._process.join(_JOIN_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.is_alive()

    def move(self, axle: Pose) -> None:
        """Tell the camera where the robot is: pose of its axle's centre in the scene."""
        self._axle[:] = list(axle)

    def become(self, state: State) -> None:
        """Change what the camera does."""
        self._state.value = state


def _serve(
    spec: CameraSpec,
    axle: SynchronizedArray[float],
    state: Synchronized[int],
    parent: Connection,
) -> None:
    """Be the camera's process until the parent hangs up or dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    try:
        studio = _Studio(spec)
        server = MjpegServer(spec.port)
    except VisctrlError as error:
        parent.send(error)
        return
    with contextlib.suppress(EOFError, OSError), server:
        parent.send(server.url)
        due = time.monotonic()
        while not parent.poll(max(0.0, due - time.monotonic())):
            due = max(due + 1.0 / spec.fps, time.monotonic())
            _show(server, studio, Pose(*axle[:]), State(state.value))
        parent.recv()


def _show(server: MjpegServer, studio: _Studio, axle: Pose, state: State) -> None:
    if state is State.DROPPED:
        server.drop()
        return
    server.restore()
    if state is State.WORKING:
        server.publish(studio.jpeg(axle))


class _Studio:
    """Takes pictures. The drawing libraries are imported in this process only."""

    def __init__(self, spec: CameraSpec) -> None:
        from visctrl.sim.render.imaging import Sensor
        from visctrl.sim.render.renderer_choice import open_renderer
        from visctrl.sim.world.scene import load_scene

        camera = spec.camera
        self._mount = spec.mount
        self._renderer = open_renderer(spec.renderer, load_scene(spec.scene), camera)
        self._sensor = Sensor(
            camera.width, camera.height, spec.image_noise, blur_px=0.0, exposure=0.0, seed=spec.seed
        )
        self._taken = 0

    def jpeg(self, axle: Pose) -> bytes:
        """Return a picture from where the camera is now."""
        import cv2

        pose = Pose(*step_exact(axle, self._mount.forward_m, 0.0, 1.0).tolist())
        ideal = self._renderer.render(pose, self._mount.height_m)
        self._taken += 1
        picture = self._sensor.expose(ideal, time.monotonic(), self._taken)
        quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        return cv2.imencode(".jpg", picture, quality)[1].tobytes()
