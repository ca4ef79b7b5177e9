"""The target view: pictures from where the robot stands, or from where a simulated one goes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from visctrl.hal.errors import CameraError
from visctrl.hal.interfaces import Backend
from visctrl.hal.types import Frame
from visctrl.robots.errors import InputError
from visctrl.runtime.plan import Plan
from visctrl.runtime.target_view import TargetView, now_text

#: Longest wait for another picture (s): frames come ten times a second and more.
_PICTURE_S = 2.0
_POLL_S = 0.01


def take_target(plan: Plan, count: int) -> tuple[TargetView, list[Frame]]:
    """Return the view from where the robot stands, and its ``count`` pictures.

    Raises
    ------
    InputError, DeviceError
        The backend takes no pictures, or a device cannot be used.
    """
    if plan.backend.delivers_features:
        raise InputError(f"backend '{plan.scenario.backend}' takes no pictures")
    with plan.open_backend() as backend:
        frames = backend.teach(count) or list(_pictures(backend, count))
        view = TargetView(
            images=np.stack([np.asarray(frame.image) for frame in frames]),
            camera=plan.camera,
            odometry=backend.base.odometry().pose,
            backend=plan.scenario.backend,
            robot=plan.robot.name,
            taken=now_text(),
            mount=plan.mount,
        )
    return view, frames


def _pictures(backend: Backend, count: int) -> Iterator[Frame]:
    """Yield pictures that follow each other."""
    clock = backend.clock
    last = -1
    for _ in range(count):
        deadline = clock.now() + _PICTURE_S
        while (frame := backend.camera.read()).sequence == last:
            if clock.now() > deadline:
                raise CameraError(f"no new picture for {_PICTURE_S:g} s")
            clock.sleep_until(clock.now() + _POLL_S)
        last = frame.sequence
        yield frame
