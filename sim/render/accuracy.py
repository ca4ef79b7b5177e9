"""How far rendered pictures lie from the camera model: corners of known points, found again.

A room of checkerboards surrounds the camera. Each corner's image is predicted by the camera's
`project` and, independently, found in the rendered frame by its grey values.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Pose
from visctrl.sim.render.reliefs import CHECK_M
from visctrl.sim.render.renderer import Renderer
from visctrl.sim.render.surfaces import Surface, surfaces
from visctrl.sim.world.frames import heading_matrix
from visctrl.sim.world.scene import Finish, Ground, Item, Room, Scene

Array = NDArray[np.float64]

#: Half side of the window in which a corner is searched (px).
_WINDOW_PX = 4
#: A corner is used if its squares are at least this long in the image (px).
_SQUARE_PX = 10.0
#: Side of the blocks in which the field's coverage is counted (px).
_BLOCK_PX = 50
_HALF_M, _HEIGHT_M = 2.5, 2.5
#: Floor and ceiling are laid out with thin square boards.
_BOARD_M, _SLAB_M = 1.25, 0.002
_BOARD_CENTRES_M = (-1.875, -0.625, 0.625, 1.875)


@dataclass(frozen=True)
class CornerErrors:
    """Result of `measure_corners`.

    pixels : (N, 2) predicted corners (px).
    errors : (N, 2) found minus predicted (px).
    coverage : share of the image's blocks with valid pixels that hold a corner.
    """

    pixels: Array
    errors: Array
    coverage: float

    @property
    def distances(self) -> Array:
        """Length of each error (N,) (px)."""
        return np.asarray(np.linalg.norm(self.errors, axis=-1))

    def percentile(self, share: float) -> float:
        """Return the distance (px) that ``share`` (0 to 1) of the corners do not exceed."""
        return float(np.quantile(self.distances, share))


def checker_room() -> Scene:
    """Return a closed room, every side of it a checkerboard."""
    board = Finish(pattern="checker", shade=0.5, contrast=0.35)
    boards = [
        Item(
            name=f"{where} board {x:g} {y:g}",
            at_m=(x, y),
            size_m=(_BOARD_M, _BOARD_M, _SLAB_M),
            bottom_m=bottom,
            margin_m=0.0,
            **board.model_dump(),
        )
        for where, bottom in (("floor", 0.0), ("ceiling", _HEIGHT_M - 2.0 * _SLAB_M))
        for x in _BOARD_CENTRES_M
        for y in _BOARD_CENTRES_M
    ]
    extent = (-_HALF_M, _HALF_M)
    plain = Ground(shade=0.5, contrast=0.0)
    room = Room(
        x_m=extent, y_m=extent, height_m=_HEIGHT_M, tile_m=_BOARD_M, walls=board, floor=plain
    )
    return Scene(name="checker room", room=room, items=tuple(boards))


def measure_corners(
    renderer: Renderer, camera: CentralCamera, poses: list[Pose], height_m: float = 0.75
) -> CornerErrors:
    """Compare a renderer of `checker_room` with the camera model.

    Which corners count is decided by geometry alone (resolved well enough, window within the
    field of view); what is found there counts, however far off.
    """
    points = _corner_points(checker_room())
    pixels, errors = [], []
    for pose in poses:
        image = renderer.render(pose, height_m)
        predicted = _predicted(camera, points, pose, height_m)
        found = cv2.cornerSubPix(
            image,
            np.ascontiguousarray(predicted[:, None], dtype=np.float32),
            (_WINDOW_PX, _WINDOW_PX),
            (-1, -1),
            (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-4),
        )
        pixels.append(predicted)
        errors.append(np.asarray(found, dtype=np.float64)[:, 0] - predicted)
    seen = np.concatenate(pixels)
    return CornerErrors(seen, np.concatenate(errors), _coverage(camera, seen))


def _corner_points(scene: Scene) -> Array:
    """Return each board corner with its neighbours along the board, (N, 3, 3)."""
    corners = [
        _board_corners(surface) for surface in surfaces(scene) if surface.pattern.kind == "checker"
    ]
    return np.concatenate(corners)


def _board_corners(surface: Surface) -> Array:
    width, height = surface.pattern.width_m, surface.pattern.height_m
    side = surface.side
    right, up = side.right / width, side.up / height
    across = np.arange(1, round(width / CHECK_M)) * CHECK_M
    # Squares are counted from the upper edge.
    down = height - np.arange(1, round(height / CHECK_M)) * CHECK_M
    a, b = np.meshgrid(across, down)
    points = side.corner + a.reshape(-1, 1) * right + b.reshape(-1, 1) * up
    beside = CHECK_M * np.stack([np.zeros(3), right, up])
    return np.asarray(points[:, None] + beside, dtype=np.float64)


def _predicted(camera: CentralCamera, points: Array, pose: Pose, height_m: float) -> Array:
    """Return the images (M, 2) of those corners that can be found."""
    eye = np.array([pose.x, pose.y, height_m])
    rays = (points - eye) @ heading_matrix(pose.phi)
    pixels, valid = camera.robot_pixels(rays)
    corner = pixels[:, 0]
    along = [pixels[:, k] - corner for k in (1, 2)]
    # The shorter height of the parallelogram that a square becomes.
    area = np.abs(along[0][:, 0] * along[1][:, 1] - along[0][:, 1] * along[1][:, 0])
    longest = np.maximum(np.linalg.norm(along[0], axis=-1), np.linalg.norm(along[1], axis=-1))
    rim = _WINDOW_PX + 2
    around = np.array([[i, j] for i in (-rim, 0, rim) for j in (-rim, 0, rim)])
    inside = camera.unproject(np.nan_to_num(corner)[:, None] + around)[1].all(axis=-1)
    usable = valid.all(axis=-1) & inside & (area / longest >= _SQUARE_PX)
    return np.asarray(corner[usable], dtype=np.float64)


def _coverage(camera: CentralCamera, pixels: Array) -> float:
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    _, valid = camera.unproject(np.stack([u, v], axis=-1).astype(np.float64))
    shape = (camera.height // _BLOCK_PX + 1, camera.width // _BLOCK_PX + 1)
    shown, held = np.zeros(shape), np.zeros(shape)
    np.add.at(shown, (v // _BLOCK_PX, u // _BLOCK_PX), valid)
    blocks = np.clip((pixels // _BLOCK_PX).astype(int), 0, None)
    np.add.at(held, (blocks[:, 1], blocks[:, 0]), 1)
    # Blocks that are mostly outside the field cannot hold a whole window.
    needed = shown > 0.5 * _BLOCK_PX**2
    return float(np.mean(held[needed] > 0))
