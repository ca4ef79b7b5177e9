"""Known cameras calibrated from rendered images: how near the calibration comes to the truth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from visctrl.calibration.boards import Board
from visctrl.calibration.camera import BoardView, calibrate
from visctrl.calibration.centre import find_centre
from visctrl.calibration.edges import Segments, find_segments
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Pose
from visctrl.reproduce.entry import Bench, Row, within
from visctrl.sim.render.board_images import hold, photographed
from visctrl.sim.render.renderer import BulletRenderer
from visctrl.sim.world.scene import load_scene

Array = NDArray[np.float64]

_CHECKERBOARD = Board("checkerboard", 8, 6, 0.05)
_CHARUCO = Board("charuco", 6, 5, 0.07)
#: Camera, board, where it is held: polar angles (deg) and distances (m), least and greatest.
#: Markers in a mirror's picture of this size are too small to be read.
_BOARDS: tuple[tuple[str, Board, tuple[float, float], tuple[float, float]], ...] = (
    ("perspective", _CHECKERBOARD, (0.0, 18.0), (0.6, 1.1)),
    ("perspective", _CHARUCO, (0.0, 22.0), (0.55, 1.1)),
    ("hypercatadioptric", _CHECKERBOARD, (55.0, 110.0), (0.25, 0.38)),
    ("paracatadioptric", _CHECKERBOARD, (58.0, 108.0), (0.25, 0.38)),
    ("fisheye", _CHECKERBOARD, (0.0, 86.0), (0.25, 0.4)),
    ("fisheye", _CHARUCO, (0.0, 80.0), (0.28, 0.4)),
)
_VIEWS = 36
#: What is asked for: K (relative), the angle between rays, in the whole field of view.
_K_PERCENT, _RAY_DEG = 0.5, 0.05
#: Off the image's centre, which a calibration might start from.
_OFF_PX = (4.6, 16.2)

#: Cameras with their centres displaced, and how many images each takes in the hall.
_CENTRES: tuple[tuple[str, int, tuple[float, float]], ...] = (
    ("hypercatadioptric", 800, (404.0, 316.0)),
    ("paracatadioptric", 800, (392.3, 290.7)),
    ("hypercatadioptric", 1024, (541.0, 405.0)),
)
_SEQUENCE = 12
_CENTRE_PX = 1.0
_HEIGHT_M = 0.7


def cameras(bench: Bench) -> list[Row]:
    """Calibrate every camera from rendered boards: greatest errors in its field of view."""
    rows = []
    for done, (name, board, polar, distance) in enumerate(_BOARDS):
        bench.announce(len(_BOARDS), done)
        camera = load_camera(name)
        camera = camera.altered(cx=camera.cx + _OFF_PX[0], cy=camera.cy + _OFF_PX[1])
        sights = list(_sights(camera, board, polar, distance))
        found = calibrate(board, sights, (camera.width, camera.height), "auto", name).camera
        shares = [abs(getattr(found, k) / getattr(camera, k) - 1.0) for k in ("fx", "fy")]
        ours = {
            "K_percent": 100.0 * max(shares),
            "ray_deg": float(ray_errors_deg(camera, found).max()),
            "centre_px": float(np.hypot(found.cx - camera.cx, found.cy - camera.cy)),
            "images": float(len(sights)),
        }
        bounds = {"K_percent": _K_PERCENT, "ray_deg": _RAY_DEG}
        rows.append(within(f"{name}, {board.kind}", bounds, ours))
    bench.announce(len(_BOARDS), len(_BOARDS))
    return rows


def centres(bench: Bench) -> list[Row]:
    """Find the centres of mirror cameras from what they see in the simulated hall."""
    rows = []
    for done, (name, width, (cx, cy)) in enumerate(_CENTRES):
        bench.announce(len(_CENTRES), done)
        camera = load_camera(name)
        camera = camera.resized(width, width * camera.height // camera.width).altered(cx=cx, cy=cy)
        segments = Segments.joined([find_segments(image) for image in _hall(camera)])
        point = find_centre(segments, (camera.width, camera.height), seed=0).point
        ours = {"x_px": abs(point[0] - cx), "y_px": abs(point[1] - cy)}
        bounds = {"x_px": _CENTRE_PX, "y_px": _CENTRE_PX}
        rows.append(within(f"{name} {camera.width}x{camera.height}", bounds, ours))
    bench.announce(len(_CENTRES), len(_CENTRES))
    return rows


def ray_errors_deg(true: CentralCamera, found: CentralCamera) -> Array:
    """Return the angles (deg) between two cameras' rays, all over the true one's field of view."""
    v, u = np.mgrid[0 : true.height : 5, 0 : true.width : 5]
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
    a, seen = true.unproject(pixels)
    b = found.altered(min_polar_deg=0.0, max_polar_deg=180.0).unproject(pixels)[0]
    cross = np.linalg.norm(np.cross(a[seen], b[seen]), axis=1)
    return np.asarray(np.degrees(np.arctan2(cross, (a[seen] * b[seen]).sum(axis=1))))


def _sights(
    camera: CentralCamera,
    board: Board,
    polar_deg: tuple[float, float],
    distance_m: tuple[float, float],
) -> Iterator[BoardView]:
    """Yield the boards that are found in images of them held all over the field of view."""
    rng = np.random.default_rng(11)
    picture, rim = board.picture(40)
    size = (board.size_m[0] + 2 * rim, board.size_m[1] + 2 * rim)
    for k in range(_VIEWS):
        polar = np.radians(rng.uniform(*polar_deg))
        # The golden angle spreads them about the axis.
        place = (float(polar), 2.39996 * k, rng.uniform(*distance_m))
        corners = board.find(hold(camera, picture, size, place, rng))
        if corners is not None:
            yield BoardView(f"view {k}", corners)


def _hall(camera: CentralCamera) -> Iterator[NDArray[np.uint8]]:
    rng = np.random.default_rng(5)
    renderer = BulletRenderer(load_scene("hall"), camera)
    try:
        for _ in range(_SEQUENCE):
            pose = Pose(rng.uniform(-1.0, 1.0), rng.uniform(-3.0, 0.0), rng.uniform(-3.0, 3.0))
            yield photographed(renderer.render(pose, _HEIGHT_M), 0.5, 2.0, rng)
    finally:
        renderer.close()
