"""Command-line options as overrides of a scenario."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from visctrl.runtime.config import Override, parse_setting


def flag_overrides(
    *,
    settings: Sequence[str] | None = None,
    backend: str | None = None,
    scheme: str | None = None,
    robot: str | None = None,
    camera: str | None = None,
    start: tuple[float, float, float] | None = None,
    duration: float | None = None,
    seed: int | None = None,
    noise_px: float | None = None,
    tolerance: tuple[float, float] | None = None,
    realtime: bool | None = None,
    target: str | None = None,
    port: str | None = None,
    camera_url: str | None = None,
    gui: bool = False,
    record_images: bool = False,
) -> list[Override]:
    """Return the overrides that options ask for: ``--set`` first, the others win over it."""
    x, y, phi = start or (None, None, None)
    position, heading = tolerance or (None, None)
    wanted: list[tuple[str, str, Any]] = [
        ("--backend", "backend", backend),
        ("--scheme", "scheme", scheme),
        ("--robot", "robot", robot),
        ("--camera", "camera.name", camera),
        ("--start", "start.x_m", x),
        ("--start", "start.y_m", y),
        ("--start", "start.phi_deg", phi),
        ("--duration", "duration_s", duration),
        ("--seed", "seed", seed),
        ("--noise-px", "mock.noise_px", noise_px),
        ("--tolerance", "tolerance.position_m", position),
        ("--tolerance", "tolerance.heading_deg", heading),
        ("--realtime", "realtime", realtime),
        ("--target", "target.file", target),
        ("--port", "pioneer.port", port),
        ("--camera-url", "pioneer.camera.source", camera_url),
        ("--gui", "sim.gui", True if gui else None),
        ("--record-images", "record_images", True if record_images else None),
    ]
    flags = [
        Override(tuple(key.split(".")), value, f"{option} {value}")
        for option, key, value in wanted
        if value is not None
    ]
    return [parse_setting(text) for text in settings or ()] + flags
