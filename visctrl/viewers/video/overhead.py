"""The robot from above, drawn into a picture while it drives."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from visctrl.contracts import Array
from visctrl.hal.types import Pose
from visctrl.viewers.report.topview import Outline
from visctrl.viewers.video.frames import Image

_BACK, _GRID, _LABEL = (252, 250, 249), (236, 230, 225), (130, 115, 100)
_PATH, _ROBOT, _TARGET = (201, 98, 36), (30, 84, 217), (30, 38, 179)
#: Widest distance between grid lines (px), and what they may be apart (m).
_APART = 70.0
_STEPS = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
#: Room around everything, in robot lengths.
_ROOM = 0.75


def draw_overhead(
    size: tuple[int, int], path: Sequence[Pose], robot: Pose, target: Pose | None, outline: Outline
) -> Image:
    """Return a picture (height, width, 3) of path, robot and target; x is right, y is up.

    Parameters
    ----------
    size : (width, height)
        Of the picture (px).
    path : sequence of Pose
        Camera poses so far.
    robot : Pose
        Of the camera now; nothing but the path is drawn while it is not finite.
    target : Pose or None
        Of the camera, where it is known.
    outline : Outline
        Of the robot.
    """
    width, height = size
    picture: Image = np.full((height, width, 3), _BACK, dtype=np.uint8)
    places = [(pose.x, pose.y) for pose in (*path, robot, *([target] if target else []))]
    known = np.array([place for place in places if all(map(math.isfinite, place))] or [(0.0, 0.0)])
    room = _ROOM * float(np.ptp(outline.corners[:, 1]))
    low, high = known.min(axis=0) - room, known.max(axis=0) + room
    scale = float(min(width / (high[0] - low[0]), height / (high[1] - low[1])))
    middle = (low + high) / 2.0

    def pixels(points: Array) -> np.ndarray:
        u = width / 2.0 + scale * (points[:, 0] - middle[0])
        v = height / 2.0 - scale * (points[:, 1] - middle[1])
        return np.round(np.stack([u, v], axis=1)).astype(np.int32)

    _grid(picture, scale, middle)
    if target is not None:
        shape = pixels(outline.at(target))
        cv2.polylines(picture, [shape], True, _TARGET, 2, cv2.LINE_AA)
        (centre,) = pixels(np.array([[target.x, target.y]]))
        cv2.drawMarker(picture, centre.tolist(), _TARGET, cv2.MARKER_CROSS, 16, 2, cv2.LINE_AA)
    if path:
        line = pixels(np.array([(pose.x, pose.y) for pose in path]))
        cv2.polylines(picture, [line], False, _PATH, 2, cv2.LINE_AA)
    if all(map(math.isfinite, robot)):
        shape = pixels(outline.at(robot))
        tint = picture.copy()
        cv2.fillPoly(tint, [shape], _ROBOT, cv2.LINE_AA)
        cv2.addWeighted(tint, 0.18, picture, 0.82, 0.0, picture)
        cv2.polylines(picture, [shape], True, _ROBOT, 2, cv2.LINE_AA)
        reach = float(outline.corners[:, 1].max())
        nose = [robot.x - reach * math.sin(robot.phi), robot.y + reach * math.cos(robot.phi)]
        ends = pixels(np.array([[robot.x, robot.y], nose]))
        cv2.polylines(picture, [ends], False, _ROBOT, 2, cv2.LINE_AA)
    return picture


def _grid(picture: Image, scale: float, middle: Array) -> None:
    """Draw lines a round number of metres apart, with their coordinates."""
    height, width = picture.shape[:2]
    step = next((step for step in _STEPS if step * scale >= _APART), 2.0 * _STEPS[-1])
    font = cv2.FONT_HERSHEY_SIMPLEX
    for axis, extent in ((0, width), (1, height)):
        reach = extent / (2.0 * scale)
        first = math.ceil((middle[axis] - reach) / step)
        last = math.floor((middle[axis] + reach) / step)
        for k in range(first, last + 1):
            offset = scale * (k * step - float(middle[axis]))
            label = f"{k * step:g} m"
            if axis == 0:
                u = round(width / 2.0 + offset)
                cv2.line(picture, (u, 0), (u, height), _GRID, 1)
                cv2.putText(picture, label, (u + 4, height - 6), font, 0.4, _LABEL, 1, cv2.LINE_AA)
            else:
                v = round(height / 2.0 - offset)
                cv2.line(picture, (0, v), (width, v), _GRID, 1)
                cv2.putText(picture, label, (4, v - 5), font, 0.4, _LABEL, 1, cv2.LINE_AA)
