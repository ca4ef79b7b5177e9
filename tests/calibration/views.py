"""Images of boards and of rooms through known cameras."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from hal.central_camera import CentralCamera
from sim.board_images import draw_plane, photographed
from visctrl.calibration.boards import Board


def facing(direction: np.ndarray, roll: float, tilt: tuple[float, float]) -> np.ndarray:
    """Return axes (right, down, away) of a board in that direction, rolled and tilted."""
    away = direction / np.linalg.norm(direction)
    other = np.eye(3)[2] if abs(away[2]) < 0.9 else np.eye(3)[1]
    right = np.cross(other, away)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(away, right), away], axis=1)
    turn, lean = (cv2.Rodrigues(np.array(v))[0] for v in ((0.0, 0.0, roll), (*tilt, 0.0)))
    return axes @ turn @ lean


def board_image(
    camera: CentralCamera,
    board: Board,
    polar: float,
    azimuth: float,
    distance: float,
    rng: np.random.Generator,
    samples: int = 3,
) -> np.ndarray:
    """Return a noisy picture of a board, its centre in a direction (rad) at a distance (m)."""
    s = np.sin(polar)
    direction = np.array([s * np.cos(azimuth), s * np.sin(azimuth), np.cos(polar)])
    axes = facing(direction, rng.uniform(-np.pi, np.pi), tuple(rng.uniform(-0.5, 0.5, 2)))
    picture, rim = board.picture(40)
    size = (board.size_m[0] + 2 * rim, board.size_m[1] + 2 * rim)
    corner = distance * direction - axes @ np.array([size[0] / 2, size[1] / 2, 0.0])
    background = np.full((camera.height, camera.width), 110, np.uint8)
    clean = draw_plane(camera, picture, size, axes, corner, background, samples)
    return photographed(clean, 0.6, 2.0, rng)


def ray_errors_deg(true: CentralCamera, found: CentralCamera) -> np.ndarray:
    """Return the angles between two cameras' rays of the pixels of the true one's field."""
    v, u = np.mgrid[0 : true.height : 5, 0 : true.width : 5]
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(float)
    a, seen = true.unproject(pixels)
    b = found.altered(min_polar_deg=0.0, max_polar_deg=180.0).unproject(pixels)[0]
    cross = np.linalg.norm(np.cross(a[seen], b[seen]), axis=1)
    return np.degrees(np.arctan2(cross, (a[seen] * b[seen]).sum(axis=1)))


def save(folder: Path, images: list[np.ndarray]) -> Path:
    """Write images into a new folder."""
    folder.mkdir()
    for number, image in enumerate(images):
        cv2.imwrite(str(folder / f"view{number:02d}.png"), image)
    return folder
