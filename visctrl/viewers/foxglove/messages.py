"""A run's ticks as Foxglove messages: image, calibration, tracks, pose, path, scene, plots.

Frames follow REP-103: ``target`` (or ``odometry``), ``base_link`` on the floor below the axle,
``camera`` with its z axis along the optical axis. Needs the package ``foxglove-sdk``.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from foxglove import Channel, Context, messages
from foxglove.channels import (
    CameraCalibrationChannel,
    CompressedImageChannel,
    FrameTransformsChannel,
    ImageAnnotationsChannel,
    LogChannel,
    PoseInFrameChannel,
    PosesInFrameChannel,
    SceneUpdateChannel,
)
from scipy.spatial.transform import Rotation

from visctrl.contracts import Array, Views
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Frame, Pose, Velocity
from visctrl.robots.unicycle import to_rep103
from visctrl.runtime.records import STAGES, Setup, TickRecord
from visctrl.viewers.trace import Trace

#: What stays the same is sent again after so long, for viewers that come late (s); the path, too.
_AGAIN_S = 1.0
_PATH_POSES = 500
_TRAIL = 10
_JPEG_QUALITY = 80
_NS = 1_000_000_000
_CAMERA, _BASE = "camera", "base_link"
_GREEN = messages.Color(r=0.35, g=0.9, b=0.43, a=1.0)
_ORANGE = messages.Color(r=1.0, g=0.67, b=0.16, a=0.85)
_BLUE = messages.Color(r=0.2, g=0.45, b=0.85, a=0.8)
_RED = messages.Color(r=0.85, g=0.2, b=0.15, a=0.35)
_STANDARD_AXES = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


class Publisher:
    """Logs every tick to the sinks of a context.

    Parameters
    ----------
    setup : Setup
        Of the run.
    context : Context
        Of the sinks: a file, a server.
    epoch_ns : int
        Time of the run's first tick (ns since 1970).
    """

    def __init__(self, setup: Setup, context: Context, epoch_ns: int) -> None:
        self._setup = setup
        self._epoch_ns = epoch_ns
        self._image = CompressedImageChannel("/camera/image", context=context)
        self._calibration = CameraCalibrationChannel("/camera/calibration", context=context)
        self._tracks = ImageAnnotationsChannel("/camera/tracks", context=context)
        self._pose = PoseInFrameChannel("/pose", context=context)
        self._path = PosesInFrameChannel("/path", context=context)
        self._transforms = FrameTransformsChannel("/tf", context=context)
        self._scene = SceneUpdateChannel("/scene", context=context)
        self._log = LogChannel("/log", context=context)
        self._plots = Channel(
            "/tick", schema={"type": "object", "additionalProperties": True}, context=context
        )
        self._trace = Trace(_PATH_POSES)
        self._recent: deque[Views] = deque(maxlen=_TRAIL)
        self._again_at = -math.inf
        self._event = ""

    def publish(self, record: TickRecord) -> None:
        """Log one tick."""
        now = self._epoch_ns + round(record.t * _NS)
        stamp = messages.Timestamp(sec=now // _NS, nsec=now % _NS)
        pose = record.truth or record.odometry.pose
        world = "target" if record.truth is not None else "odometry"
        self._recent.append(record.views)
        self._trace.add(pose)
        data = _jpeg(record.frame, self._setup.camera)
        image = messages.CompressedImage(
            timestamp=stamp, frame_id=_CAMERA, data=data, format="jpeg"
        )
        self._image.log(image, log_time=now)
        self._tracks.log(_annotations(self._recent, stamp), log_time=now)
        self._plots.log(_numbers(record), log_time=now)
        if math.isfinite(pose.x):
            self._pose.log(
                messages.PoseInFrame(timestamp=stamp, frame_id=world, pose=_pose(pose)),
                log_time=now,
            )
            self._transforms.log(self._frames(pose, world, stamp), log_time=now)
        if record.event and record.event != self._event:
            level = messages.LogLevel.Warning
            entry = messages.Log(timestamp=stamp, level=level, message=record.event, name="safety")
            self._log.log(entry, log_time=now)
        self._event = record.event
        if record.t - self._again_at >= _AGAIN_S:
            self._again_at = record.t
            self._publish_again(world, stamp, now)

    def _publish_again(self, world: str, stamp: messages.Timestamp, now: int) -> None:
        poses = [_pose(pose) for pose in self._trace.poses]
        path = messages.PosesInFrame(timestamp=stamp, frame_id=world, poses=poses)
        self._path.log(path, log_time=now)
        self._calibration.log(_calibration(self._setup.camera, stamp), log_time=now)
        self._scene.log(self._entities(world, stamp), log_time=now)

    def _frames(
        self, pose: Pose, world: str, stamp: messages.Timestamp
    ) -> messages.FrameTransforms:
        """Return where the base is in the world and the camera on the base."""
        x, y, yaw = (float(value) for value in to_rep103(pose))
        mount = self._setup.mount
        ahead = mount.forward_m
        axle = messages.Vector3(x=x - ahead * math.cos(yaw), y=y - ahead * math.sin(yaw))
        base = messages.FrameTransform(
            timestamp=stamp,
            parent_frame_id=world,
            child_frame_id=_BASE,
            translation=axle,
            rotation=_about_z(yaw),
        )
        axes = Rotation.from_matrix(_STANDARD_AXES @ self._setup.camera.rotation)
        qx, qy, qz, qw = axes.as_quat().tolist()
        camera = messages.FrameTransform(
            timestamp=stamp,
            parent_frame_id=_BASE,
            child_frame_id=_CAMERA,
            translation=messages.Vector3(x=ahead, z=mount.height_m),
            rotation=messages.Quaternion(x=qx, y=qy, z=qz, w=qw),
        )
        return messages.FrameTransforms(transforms=[base, camera])

    def _entities(self, world: str, stamp: messages.Timestamp) -> messages.SceneUpdate:
        """Return the robot's body, and where it is to stand if that is known."""
        entities = [self._body("robot", _BASE, _BLUE, 0.0, stamp)]
        if world == "target":
            ahead = self._setup.mount.forward_m
            entities.append(self._body("target", world, _RED, -ahead, stamp))
        return messages.SceneUpdate(entities=entities)

    def _body(
        self,
        name: str,
        frame: str,
        colour: messages.Color,
        axle: float,
        stamp: messages.Timestamp,
    ) -> messages.SceneEntity:
        """Return the robot as a box; its axle is at x = ``axle`` in the frame (m)."""
        body = self._setup.robot.body
        middle = messages.Vector3(
            x=axle + (body.front_m - body.rear_m) / 2.0, z=body.height_m / 2.0
        )
        box = messages.CubePrimitive(
            pose=messages.Pose(position=middle, orientation=_about_z(0.0)),
            size=messages.Vector3(x=body.front_m + body.rear_m, y=body.width_m, z=body.height_m),
            color=colour,
        )
        return messages.SceneEntity(
            timestamp=stamp, frame_id=frame, id=name, frame_locked=True, cubes=[box]
        )


def _pose(pose: Pose) -> messages.Pose:
    x, y, yaw = (float(value) for value in to_rep103(pose))
    return messages.Pose(position=messages.Vector3(x=x, y=y), orientation=_about_z(yaw))


def _about_z(yaw: float) -> messages.Quaternion:
    return messages.Quaternion(z=math.sin(yaw / 2.0), w=math.cos(yaw / 2.0))


def _jpeg(frame: Frame, camera: CentralCamera) -> bytes:
    """Return a frame's image, or a dark canvas for one that carries features only."""
    image = frame.image
    if image is None:
        image = np.full((camera.height, camera.width), 32, dtype=np.uint8)
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return data.tobytes()


def _calibration(camera: CentralCamera, stamp: messages.Timestamp) -> messages.CameraCalibration:
    """Return the calibration; only a perspective camera has a projection matrix P.

    ``distortion_model`` is the model where it is not perspective, D its coefficients.
    """
    K = camera.K.ravel().tolist()
    perspective = camera.rectilinear
    P = [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]
    return messages.CameraCalibration(
        timestamp=stamp,
        frame_id=_CAMERA,
        width=camera.width,
        height=camera.height,
        distortion_model="" if perspective else camera.model,
        D=[] if perspective else list(camera.coefficients.values()),
        K=K,
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=P if perspective else [0.0] * 12,
    )


def _annotations(recent: deque[Views], stamp: messages.Timestamp) -> messages.ImageAnnotations:
    """Return the newest features as points, and where they were in the last ticks as lines."""
    newest = recent[-1]
    lines: list[messages.Point2] = []
    after = _by_id(newest)
    for views in list(recent)[-2::-1]:
        before = _by_id(views)
        for name, pixel in before.items():
            if name in after:
                lines += [_point(pixel), _point(after[name])]
        after = before
    return messages.ImageAnnotations(
        timestamp=stamp,
        points=[
            messages.PointsAnnotation(
                timestamp=stamp,
                type=messages.PointsAnnotationType.LineList,
                points=lines,
                outline_color=_ORANGE,
                thickness=1.5,
            ),
            messages.PointsAnnotation(
                timestamp=stamp,
                type=messages.PointsAnnotationType.Points,
                points=[_point(pixel) for pixel in newest.pixels],
                outline_color=_GREEN,
                thickness=5.0,
            ),
        ],
    )


def _by_id(views: Views) -> dict[int, Array]:
    return dict(zip(views.ids.tolist(), views.pixels, strict=True))


def _point(pixel: Array) -> messages.Point2:
    return messages.Point2(x=float(pixel[0]), y=float(pixel[1]))


def _numbers(record: TickRecord) -> dict[str, Any]:
    """Return everything that can be plotted; what is not known is left out."""
    seconds = zip(STAGES[:-1], record.seconds, strict=True)
    numbers: dict[str, Any] = {
        "tick": record.number,
        "t_s": record.t,
        "stage": record.stage,
        "phase": record.decision.phase,
        "event": record.event,
        "features": len(record.views),
        "views_health": record.views.health.value,
        "estimate_health": record.estimate.health.value,
        "battery_v": record.battery_v,
        "sent": _speeds(record.sent),
        "wanted": _speeds(record.decision.velocity),
        "measured": _speeds(record.odometry.velocity),
        "stages_ms": {name: 1000.0 * part for name, part in seconds},
        "lateness_ms": 1000.0 * record.tick.lateness,
        "missed": record.tick.missed,
        "signals": {name: _finite(values) for name, values in record.signals},
    }
    if record.truth is not None:
        x, y, phi = record.truth
        numbers["error"] = {"x_m": x, "y_m": y, "phi_deg": math.degrees(phi)}
    return numbers


def _speeds(velocity: Velocity) -> dict[str, float]:
    v, omega = velocity
    return _finite({"v_m_s": v, "omega_deg_s": math.degrees(omega)})


def _finite(values: Mapping[str, float]) -> dict[str, float]:
    return {name: float(value) for name, value in values.items() if math.isfinite(value)}
