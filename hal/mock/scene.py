"""Scenes of the mock backend: points that the target and the way to it can all see."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.errors import InputError
from visctrl.hal.types import Pose
from visctrl.robots.model import Mount
from visctrl.robots.unicycle import wrap_angle

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

#: Poses between start and target from which every point must be seen, ends included.
_WAYPOINTS = 5
#: Points drawn at once, and how many of these are looked at at once at least.
_BATCH, _LEAST = 4096, 256
_ROUNDS = 16
#: Nothing hangs higher than this over the camera (m).
_CEILING_M = 2.0
#: Nothing lies on the floor itself (m).
_FLOOR_MARGIN_M = 0.05


def scatter(
    count: int,
    distance: tuple[float, float],
    camera: CentralCamera,
    mount: Mount,
    start: Pose,
    rng: np.random.Generator,
) -> Array:
    """Return ``count`` random points that are seen from the start, the target and between.

    Parameters
    ----------
    count : int
        Number of points.
    distance : (near, far)
        Horizontal distance of the points (m): from the line between start and target for a
        panoramic camera, from the target for one that looks ahead.
    camera : CentralCamera
        The camera that must see them.
    mount : Mount
        Its height bounds the points from below: none lies under the floor.
    start : Pose
        Start pose of the camera in the target's frame.
    rng : numpy Generator
        Source of the scene.

    Returns
    -------
    (count, 3) array
        (right, forward, up) in the target camera's frame (m).

    Raises
    ------
    InputError
        Start and target have no such field of view in common.
    """
    [points] = scatter_many(count, distance, camera, mount, [start], [rng])
    if points is None:
        raise InputError(
            f"start ({start.x:g} m, {start.y:g} m, {math.degrees(start.phi):g} deg): camera "
            f"'{camera.name}' sees too little there of what it sees from the target; start "
            "nearer, turn the start towards the target, or use a panoramic camera"
        )
    return points


def scatter_many(
    count: int,
    distance: tuple[float, float],
    camera: CentralCamera,
    mount: Mount,
    starts: Sequence[Pose],
    rngs: Sequence[np.random.Generator],
) -> list[Array | None]:
    """Return the scenes of many starts, None for those that see too little: see `scatter`.

    A scene does not depend on which others are made with it.
    """
    draw = _around if camera.panoramic else _ahead
    # One in four is seen all the way, more or less.
    block = min(max(_LEAST, 4 * count), _BATCH)
    drawn = [draw(distance, camera, *each, block) for each in zip(starts, rngs, strict=True)]
    poses = np.array(starts)
    poses[:, 2] = wrap_angle(poses[:, 2])
    found: list[list[Array]] = [[] for _ in starts]
    pending = list(range(len(starts)))
    while pending:
        blocks = {k: points for k in pending if (points := next(drawn[k], None)) is not None}
        if not blocks:
            break
        pending = list(blocks)
        owner = np.repeat(pending, [len(points) for points in blocks.values()])
        points = np.concatenate(list(blocks.values()))
        owner, points = _kept(owner, points, poses, distance, camera, mount)
        for k, part in zip(pending, _parted(owner, points, pending), strict=True):
            found[k].append(part)
        pending = [k for k in pending if sum(map(len, found[k])) < count]
    scenes = (np.concatenate(parts)[:count] for parts in found)
    return [scene if len(scene) == count else None for scene in scenes]


def _kept(
    owner: Indices,
    points: Array,
    starts: Array,
    distance: tuple[float, float],
    camera: CentralCamera,
    mount: Mount,
) -> tuple[Indices, Array]:
    """Return those of the points (M, 3) that may be in their owners' scenes, and their owners.

    owner : (M,) which of the starts (R, 3) a point is drawn for.
    """

    def where(keep: Mask) -> None:
        nonlocal owner, points
        owner, points = owner[keep], points[keep]

    low = -mount.height_m + _FLOOR_MARGIN_M
    where((points[:, 2] > low) & (points[:, 2] < _CEILING_M))
    aside = _distance_to_way(points, starts[owner, :2])
    where((aside >= distance[0]) & ((aside < distance[1]) | (not camera.panoramic)))
    for share in np.linspace(1.0, 0.0, _WAYPOINTS).tolist():
        where(camera.robot_pixels(_seen_from_each(points, share * starts, owner))[1])
    return owner, points


def _parted(owner: Indices, points: Array, owners: Sequence[int]) -> list[Array]:
    """Return the points of every owner; ``owner`` is sorted."""
    return np.split(points, np.searchsorted(owner, owners[1:]))


def seen_from(points: Array, pose: Pose) -> Array:
    """Return points (N, 3) of the target's frame in the axes of a camera at ``pose``."""
    to_camera = view_matrix(pose)
    return np.asarray(points @ to_camera[:3] + to_camera[3], dtype=np.float64)


def view_matrix(pose: Pose) -> Array:
    """Return the matrix (4, 3) that takes points (N, 4) as (x, y, z, 1) to a camera's axes."""
    x, y, phi = pose
    s, c = math.sin(phi), math.cos(phi)
    return np.array(
        [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0], [-c * x - s * y, s * x - c * y, 0.0]]
    )


def _seen_from_each(points: Array, poses: Array, owner: Indices) -> Array:
    """Return points (M, 3) in the axes of cameras at their owners' poses (R, 3)."""
    x, y, phi = poses.T
    s, c = np.sin(phi)[owner], np.cos(phi)[owner]
    dx, dy = points[:, 0] - x[owner], points[:, 1] - y[owner]
    return np.stack([c * dx + s * dy, c * dy - s * dx, points[:, 2]], axis=1)


def _around(
    distance: tuple[float, float],
    camera: CentralCamera,
    start: Pose,
    rng: np.random.Generator,
    block: int,
) -> Iterator[Array]:
    """Yield points about the line from start to target, of any height in view."""
    del camera
    far = distance[1]
    low = np.minimum((start.x, start.y), 0.0) - far
    extent = np.maximum((start.x, start.y), 0.0) + far - low
    for _ in range(_ROUNDS):
        plane, height = rng.random((_BATCH, 2)), rng.random(_BATCH)
        for first in range(0, _BATCH, block):
            points = np.empty((min(block, _BATCH - first), 3))
            points[:, :2] = low + extent * plane[first : first + block]
            points[:, 2] = -_CEILING_M + 2.0 * _CEILING_M * height[first : first + block]
            yield points


def _ahead(
    distance: tuple[float, float],
    camera: CentralCamera,
    start: Pose,
    rng: np.random.Generator,
    block: int,
) -> Iterator[Array]:
    """Yield points spread evenly over the target's image, at even distances from the target."""
    del start
    corner = (camera.width - 1.0, camera.height - 1.0)
    for _ in range(_ROUNDS):
        pixels, reach = rng.uniform((0.0, 0.0), corner, (_BATCH, 2)), rng.uniform(*distance, _BATCH)
        for first in range(0, _BATCH, block):
            rays, valid = camera.robot_rays(pixels[first : first + block])
            horizontal = np.hypot(rays[:, 0], rays[:, 1])
            keep = valid & (horizontal > 1e-3)
            far = reach[first : first + block] / horizontal
            yield rays[keep] * far[keep, None]


def _distance_to_way(points: Array, starts: Array) -> Array:
    """Return the horizontal distances (N,) of points from segments start to target (m).

    starts : (N, 2), that of each point.
    """
    x, y = starts.T
    length2 = np.maximum(x * x + y * y, 1e-300)
    share = np.clip((points[:, 0] * x + points[:, 1] * y) / length2, 0.0, 1.0)
    return np.asarray(np.hypot(points[:, 0] - share * x, points[:, 1] - share * y))
