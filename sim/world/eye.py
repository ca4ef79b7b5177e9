"""The simulated camera as it really is: where it sits, when it exposes, how it shakes.

A frame shows the world as it was while the shutter was open, some time before it is delivered.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.interfaces import BackendSetup
from visctrl.hal.types import Frame, Pose
from visctrl.sim.options import Changes, SimOptions
from visctrl.sim.render.imaging import Sensor
from visctrl.sim.render.renderer import Renderer
from visctrl.sim.render.renderer_choice import open_renderer
from visctrl.sim.render.shake import Shake
from visctrl.sim.world.people import Walker
from visctrl.sim.world.scene import Scene

Image = NDArray[np.uint8]

#: Pictures that a blurred one is the mean of.
_EXPOSURES = 9


class Eye:
    """Takes frames.

    Parameters
    ----------
    renderer : Renderer
        Draws the scene.
    sensor : Sensor
        Makes a picture of what is drawn.
    height_m : float
        Of the projection centre above the floor.
    latency_s, shutter_s : float
        See `visctrl.sim.options.SimOptions`.
    shake : Shake or None
        What a moving robot's frames are tilted by.
    walkers : sequence of Walker
        Placed anew for each picture.
    """

    def __init__(
        self,
        renderer: Renderer,
        sensor: Sensor,
        height_m: float,
        latency_s: float = 0.0,
        shutter_s: float = 0.0,
        shake: Shake | None = None,
        walkers: Sequence[Walker] = (),
    ) -> None:
        self.renderer = renderer
        self._sensor = sensor
        self._height_m = height_m
        self._latency_s, self._shutter_s = latency_s, shutter_s
        self._shake = shake
        self._walkers = walkers
        self._past: deque[tuple[float, Pose]] = deque()
        self._sequence = 0

    @property
    def remembers(self) -> bool:
        """Whether it needs to be told where the camera has been."""
        return self._latency_s + self._shutter_s > 0.0

    def note(self, t: float, pose: Pose) -> None:
        """Note where the camera is at ``t`` (s); times ascend."""
        self._past.append((t, pose))
        # One older than the earliest exposure stays.
        earliest = t - self._latency_s - self._shutter_s
        while len(self._past) > 1 and self._past[1][0] <= earliest:
            self._past.popleft()

    def forget(self) -> None:
        """Forget where the camera has been: it has been put somewhere else."""
        self._past.clear()

    def photograph(self, stamp: float, pose: Pose, moving: bool) -> Frame:
        """Return a frame delivered at ``stamp`` (s), when the camera is at ``pose``."""
        last = stamp - self._latency_s
        times = np.linspace(last - self._shutter_s, last, _EXPOSURES if self._shutter_s else 1)
        pictures = [self._drawn(t, self._at(t, pose)) for t in times.tolist()]
        ideal = pictures[0]
        if len(pictures) > 1:
            ideal = np.rint(np.mean(pictures, axis=0)).astype(np.uint8)
        self._sequence += 1
        if self._shake is not None and moving:
            ideal = self._shake.tilted(ideal, self._sequence)
        return Frame(stamp, self._sequence, self._sensor.expose(ideal, stamp, self._sequence))

    def close(self) -> None:
        """Release the renderer."""
        self.renderer.close()

    def _at(self, t: float, now: Pose) -> Pose:
        """Return where the camera was at ``t`` (s): the pose noted next before it."""
        if not self.remembers or not self._past:
            return now
        return next((pose for noted, pose in reversed(self._past) if noted <= t), self._past[0][1])

    def _drawn(self, t: float, pose: Pose) -> Image:
        for walker in self._walkers:
            self.renderer.place(walker.item.name, walker.pose(t))
        return self.renderer.render(pose, self._height_m)


def open_eye(
    setup: BackendSetup[SimOptions],
    scene: Scene,
    changes: Changes,
    walkers: Sequence[Walker] = (),
) -> Eye:
    """Return the camera of a simulated robot in a scene; of ``changes``, its exposure's count.

    Raises
    ------
    InputError
        The renderer does not work here.
    """
    options, model = setup.options, setup.true_camera
    sensor = Sensor(
        model.width,
        model.height,
        options.image_noise,
        options.blur_px,
        options.exposure,
        setup.seed,
        veil=options.veil,
        gain=changes.gain,
        gamma=changes.gamma,
    )
    return Eye(
        open_renderer(options.renderer, scene, model, options.detail, options.show_floor),
        sensor,
        setup.mount.height_m + options.mount_error.height_m,
        options.latency_s,
        options.shutter_s,
        Shake(model, options.shake_deg, setup.seed) if options.shake_deg else None,
        walkers,
    )
