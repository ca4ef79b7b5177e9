"""Scenes of the mock backend: points that the target and the way to it can all see."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hal.central_camera import CentralCamera
from hal.errors import InputError
from hal.types import Pose
from robots.model import Mount
from robots.unicycle import wrap_angle

Array = NDArray[np.float64]

#: Poses between start and target from which every point must be seen, ends included.
_WAYPOINTS = 5
_BATCH = 4096
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
    draw = _around if camera.panoramic else _ahead
    poses = _way(start)
    low = -mount.height_m + _FLOOR_MARGIN_M
    found: list[Array] = []
    total = 0
    for _ in range(_ROUNDS):
        points = draw(distance, camera, start, rng)
        points = points[(points[:, 2] > low) & (points[:, 2] < _CEILING_M)]
        points = points[_off_the_way(points, start, distance[0])]
        for pose in poses:
            points = points[camera.robot_pixels(seen_from(points, pose))[1]]
        found.append(points)
        total += len(points)
        if total >= count:
            return np.concatenate(found)[:count]
    raise InputError(
        f"start ({start.x:g} m, {start.y:g} m, {math.degrees(start.phi):g} deg): camera "
        f"'{camera.name}' sees too little there of what it sees from the target; start nearer, "
        "turn the start towards the target, or use a panoramic camera"
    )


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


def _way(start: Pose) -> list[Pose]:
    """Return poses from start to target, the heading changing evenly."""
    phi = float(wrap_angle(start.phi))
    return [Pose(k * start.x, k * start.y, k * phi) for k in np.linspace(1.0, 0.0, _WAYPOINTS)]


def _around(
    distance: tuple[float, float], camera: CentralCamera, start: Pose, rng: np.random.Generator
) -> Array:
    """Draw points within ``far`` of the line from start to target, of any height in view."""
    del camera
    far = distance[1]
    low = np.minimum((start.x, start.y), 0.0) - far
    high = np.maximum((start.x, start.y), 0.0) + far
    plane = rng.uniform(low, high, size=(_BATCH, 2))
    points = np.column_stack([plane, rng.uniform(-_CEILING_M, _CEILING_M, size=_BATCH)])
    return points[_distance_to_way(points, start) < far]


def _ahead(
    distance: tuple[float, float], camera: CentralCamera, start: Pose, rng: np.random.Generator
) -> Array:
    """Draw points spread evenly over the target's image, at even distances from the target."""
    del start
    pixels = rng.uniform((0.0, 0.0), (camera.width - 1.0, camera.height - 1.0), size=(_BATCH, 2))
    rays, valid = camera.robot_rays(pixels)
    reach = rng.uniform(*distance, size=_BATCH)
    horizontal = np.hypot(rays[:, 0], rays[:, 1])
    keep = valid & (horizontal > 1e-3)
    return np.asarray(rays[keep] * (reach[keep] / horizontal[keep])[:, None])


def _off_the_way(points: Array, start: Pose, clearance: float) -> NDArray[np.bool_]:
    return np.asarray(_distance_to_way(points, start) >= clearance)


def _distance_to_way(points: Array, start: Pose) -> Array:
    """Return the horizontal distance (N,) of points from the segment start to target (m)."""
    line = np.array([start.x, start.y])
    length2 = float(line @ line)
    share = points[:, :2] @ line / length2 if length2 > 0.0 else np.zeros(len(points))
    nearest = np.clip(share, 0.0, 1.0)[:, None] * line
    offset = points[:, :2] - nearest
    return np.asarray(np.hypot(offset[:, 0], offset[:, 1]))
