"""Images of boards and of rooms through known cameras."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from visctrl.calibration.boards import Board
from visctrl.hal.cameras.central import CentralCamera
from visctrl.sim.render.board_images import hold


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
    picture, rim = board.picture(40)
    size = (board.size_m[0] + 2 * rim, board.size_m[1] + 2 * rim)
    return hold(camera, picture, size, (polar, azimuth, distance), rng, samples)


def save(folder: Path, images: list[np.ndarray]) -> Path:
    """Write images into a new folder."""
    folder.mkdir()
    for number, image in enumerate(images):
        cv2.imwrite(str(folder / f"view{number:02d}.png"), image)
    return folder
