"""Scenes and exact views for the geometry tests, written from the conventions alone."""

import numpy as np

TARGET = np.zeros(3)


def scene(rng, count, near=2.0, far=6.0):
    """Points (count, 3) round the origin: x right, y forward, z above the camera."""
    azimuth = rng.uniform(-np.pi, np.pi, count)
    reach = rng.uniform(near, far, count)
    height = rng.uniform(-0.7, 1.5, count)
    return np.stack([reach * np.sin(azimuth), reach * np.cos(azimuth), height], axis=-1)


def points_seen(points, pose):
    """Points (N, 3) in the axes (right, forward, up) of a camera at (x, y, phi)."""
    x, y, phi = pose
    right, forward = np.array([np.cos(phi), np.sin(phi)]), np.array([-np.sin(phi), np.cos(phi)])
    relative = points[:, :2] - (x, y)
    return np.stack([relative @ right, relative @ forward, points[:, 2]], axis=-1)


def rays_seen(points, pose, rng=None, sigma=0.0):
    """Unit rays (N, 3), each direction turned at random by ``sigma`` (rad) in both axes."""
    rays = points_seen(points, pose)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    if sigma > 0.0:
        rays = rays + sigma * rng.normal(size=rays.shape)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays


def random_poses(rng):
    """An initial pose behind the target and a current one on the way, both (x, y, phi)."""
    initial = np.array([rng.uniform(-2, 2), rng.uniform(-5, -1.5), rng.uniform(-0.6, 0.6)])
    share = rng.uniform(0.2, 0.8)
    current = share * initial + rng.uniform(-0.2, 0.2, 3)
    return initial, current


def line_determinants(points, poses, bearings):
    """det of the three rays' lines for each feature: an oracle of the trilinear relation."""
    lines = []
    for pose, bearing in zip(poses, bearings, strict=True):
        x, y, phi = pose
        right, forward = np.array([np.cos(phi), np.sin(phi)]), np.array([-np.sin(phi), np.cos(phi)])
        direction = bearing[:, :1] * right + bearing[:, 1:2] * forward
        normal = np.stack([direction[:, 1], -direction[:, 0]], axis=-1)
        lines.append(np.column_stack([normal, -(normal @ np.array([x, y]))]))
    return np.linalg.det(np.stack(lines, axis=1))
