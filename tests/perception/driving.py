"""Drives through the ray-cast room, and the error of what a perception says on the way."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache

import numpy as np
from box_room import Room
from numpy.typing import NDArray

from visctrl.contracts import Context, Views
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Frame, Pose
from visctrl.perception.klt import Klt, KltOptions

Array = NDArray[np.float64]
NOISE = 2.0
TARGET = Pose(0.0, 0.0, 0.0)
START = Pose(-0.4, -1.2, np.radians(-20.0))
AHEAD = Pose(-0.2, -1.2, np.radians(-6.0))


@cache
def room(name: str, width: int | None = None) -> Room:
    """Return the room seen by a camera of this package, of smaller images if wanted."""
    camera = load_camera(name)
    if width is not None:
        camera = camera.resized(width, width * camera.height // camera.width)
    return Room(camera)


@cache
def target_frame(name: str, width: int | None = None) -> Frame:
    """Return the target image."""
    return room(name, width).frame(TARGET, 0, noise=NOISE)


def context(camera: CentralCamera, *, lockstep: bool = True, seed: int = 0) -> Context:
    """Return what a perception is told about the robot."""
    return Context(camera, None, 0.0, 0.1, seed, lockstep)


def tracker(name: str, width: int | None = None, **options: float) -> Klt:
    """Return a tracker that has been shown the target."""
    klt = Klt(KltOptions(**options), context(room(name, width).camera))
    klt.set_target([target_frame(name, width)])
    return klt


def line(start: Sequence[float], end: Sequence[float], count: int) -> list[Pose]:
    """Return poses from start to end in equal steps."""
    share = np.linspace(0.0, 1.0, count)[:, None]
    poses = (1.0 - share) * np.array(start) + share * np.array(end)
    return [Pose(*pose) for pose in poses.tolist()]


def frames(
    name: str, poses: Sequence[Pose], width: int | None = None, noise: float = NOISE
) -> Iterator[Frame]:
    """Yield the frames seen from poses, numbered from 1."""
    for number, pose in enumerate(poses, start=1):
        yield room(name, width).frame(pose, number, noise=noise)


def bearing_errors(views: Views, pose: Pose, seen_by: Room) -> Array:
    """Return the errors (deg) of the current bearings against the scene's geometry."""
    truth, _ = seen_by.true_rays(views.target, pose)
    right, forward = views.current[:, 0], views.current[:, 1]
    cross = right * truth[:, 1] - forward * truth[:, 0]
    dot = right * truth[:, 0] + forward * truth[:, 1]
    return np.asarray(np.abs(np.degrees(np.arctan2(cross, dot))), dtype=np.float64)
