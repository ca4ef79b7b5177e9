"""What the page shows: the newest tick and the path, kept for whoever asks."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Mapping
from typing import Any

import cv2

from visctrl.contracts import Health, Match
from visctrl.hal.types import Frame
from visctrl.robots import Robot
from visctrl.robots.model import Mount
from visctrl.runtime.records import STAGES, Observer, Setup, TickRecord
from visctrl.viewers.trace import Trace

_MOST_POINTS = 4000
_MOST_EVENTS = 30
_JPEG_QUALITY = 75
_MS = 1000.0


class LiveView(Observer):
    """Keeps a reference to the newest tick; the work is done where it is asked for.

    Every method may be called from any thread.

    Parameters
    ----------
    setup : Setup
        Of the run.
    """

    def __init__(self, setup: Setup) -> None:
        scenario = setup.scenario
        self._about = {
            "title": scenario.title or f"{scenario.scheme} on {scenario.backend}",
            "scheme": scenario.scheme,
            "backend": scenario.backend,
            "size": [setup.camera.width, setup.camera.height],
            "outline": _outline(setup.robot, setup.mount),
            "duration_s": scenario.duration_s,
            "period_ms": _MS / scenario.rate_hz,
        }
        self._lock = threading.Lock()
        self._message = "starting"
        self._record: TickRecord | None = None
        self._waiting: Frame | None = None
        self._missed = 0
        self._trace = Trace(_MOST_POINTS)
        self._events: deque[tuple[float, str]] = deque(maxlen=_MOST_EVENTS)
        self._end: dict[str, str] | None = None
        self._jpeg: tuple[Frame | None, bytes] = (None, b"")
        self._jpeg_lock = threading.Lock()

    # --- from the run ------------------------------------------------------------------------

    def on_message(self, text: str) -> None:
        """Say what is being done."""
        self._message = text

    def on_initial(self, frame: Frame, match: Match) -> None:
        """Show the initial view until the first tick."""
        self._waiting = frame

    def on_stage(self, stage: str) -> None:
        """Say that the robot drives."""
        self._message = ""

    def on_tick(self, record: TickRecord) -> None:
        """Keep a tick."""
        self._record = record
        self._missed += record.tick.missed
        with self._lock:
            if record.event and (not self._events or self._events[-1][1] != record.event):
                self._events.append((record.t, record.event))
            self._trace.add(record.truth or record.odometry.pose)

    def finish(self, status: str, reason: str) -> None:
        """Say how the run has ended."""
        self._end = {"status": status, "reason": reason}

    # --- for the page ------------------------------------------------------------------------

    @property
    def ended(self) -> bool:
        """Whether the run has."""
        return self._end is not None

    def about(self) -> Mapping[str, Any]:
        """Return what does not change during a run, ready for JSON."""
        return self._about

    def state(self, edition: int, known: int) -> dict[str, Any]:
        """Return what there is to see now, ready for JSON.

        Parameters
        ----------
        edition, known : int
            Which edition of the path the caller has, and how many of its points.
        """
        with self._lock:
            trace = self._trace
            first = known if edition == trace.edition else 0
            path = [[round(value, 4) for value in pose] for pose in trace.poses[first:]]
            found: dict[str, Any] = {
                "message": self._message,
                "missed": self._missed,
                "events": list(self._events),
                "path": {"edition": trace.edition, "from": first, "points": path},
                "end": self._end,
            }
        record = self._record
        return found if record is None else found | _tick(record)

    def image(self) -> tuple[int, bytes]:
        """Return the newest image as a JPEG with its sequence number; empty if there is none."""
        record = self._record
        frame = record.frame if record is not None else self._waiting
        if frame is None or frame.image is None:
            return -1, b""
        with self._jpeg_lock:
            if self._jpeg[0] is not frame:
                quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
                _, data = cv2.imencode(".jpg", frame.image, quality)
                self._jpeg = (frame, data.tobytes())
            return frame.sequence, self._jpeg[1]


def _outline(robot: Robot, mount: Mount) -> dict[str, float]:
    """Return the robot's extents about its camera (m)."""
    return {
        "front": robot.body.front_m - mount.forward_m,
        "rear": robot.body.rear_m + mount.forward_m,
        "half": robot.body.width_m / 2.0,
    }


def _tick(record: TickRecord) -> dict[str, Any]:
    pose = record.truth or record.odometry.pose
    views = record.views
    return {
        "tick": record.number,
        "t": round(record.t, 3),
        "stage": record.stage,
        "phase": record.decision.phase,
        "seconds": {
            name: round(_MS * part, 2)
            for name, part in zip(STAGES[:-1], record.seconds, strict=True)
        },
        "views": {"health": views.health.value, "reason": views.reason, "count": len(views)},
        "estimate": {"health": record.estimate.health.value, "reason": record.estimate.reason},
        "held": record.estimate.health is Health.LOST,
        "event": record.event,
        "battery": record.battery_v,
        "sent": _speeds(record.sent),
        "wanted": _speeds(record.decision.velocity),
        "pose": [round(value, 4) if math.isfinite(value) else None for value in pose],
        "source": "true" if record.truth is not None else "odometry",
        "ids": views.ids.tolist(),
        "pixels": [[round(u, 1), round(v, 1)] for u, v in views.pixels.tolist()],
        "sequence": record.frame.sequence,
    }


def _speeds(velocity: tuple[float, float]) -> list[float | None]:
    """Return v (m/s) and ω (deg/s); None where a plugin asked for what is no number."""
    v, omega = velocity
    return [round(value, 4) if math.isfinite(value) else None for value in (v, math.degrees(omega))]
