"""Options of a run as overrides of a scenario."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from visctrl.robots.errors import InputError
from visctrl.runtime.config import LoadedScenario, Override, load_scenario, parse_setting
from visctrl.runtime.registry import REGISTRIES


def flag_overrides(
    *,
    settings: Sequence[str] | None = None,
    backend: str | None = None,
    scheme: str | None = None,
    robot: str | None = None,
    camera: str | None = None,
    cam: int | None = None,
    start: tuple[float, float, float] | None = None,
    duration: float | None = None,
    seed: int | None = None,
    tolerance: tuple[float, float] | None = None,
    realtime: bool | None = None,
    target: str | None = None,
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
        ("--cam", "camera.cam", cam),
        ("--start", "start.x_m", x),
        ("--start", "start.y_m", y),
        ("--start", "start.phi_deg", phi),
        ("--duration", "duration_s", duration),
        ("--seed", "seed", seed),
        ("--tolerance", "tolerance.position_m", position),
        ("--tolerance", "tolerance.heading_deg", heading),
        ("--realtime", "realtime", realtime),
        ("--target", "target.file", target),
        ("--record-images", "record_images", True if record_images else None),
    ]
    flags = [
        Override(tuple(key.split(".")), value, f"{option} {value}")
        for option, key, value in wanted
        if value is not None
    ]
    return [parse_setting(text) for text in settings or ()] + flags


def load_for_backend(
    scenario: str, overrides: Sequence[Override], flags: Mapping[str, Any]
) -> LoadedScenario:
    """Load a scenario, and give its backend the options that belong to it alone.

    Parameters
    ----------
    scenario, overrides
        As `visctrl.runtime.config.load_scenario` takes them.
    flags : mapping
        Option to value, such as ``{"--port": "/dev/ttyUSB0"}``; those that are None are left
        out. Which key an option sets, the backend says (`BackendOptions.flags`).

    Raises
    ------
    InputError
        The scenario cannot be used, or the backend does not understand an option.
    """
    backends = REGISTRIES.backends.names()
    loaded = load_scenario(scenario, overrides, backends)
    given = {option: value for option, value in flags.items() if value is not None}
    if not given:
        return loaded
    backend = loaded.scenario.backend
    understood = REGISTRIES.backend_options(backend).flags
    laid = []
    for option, value in given.items():
        if option not in understood:
            others = ", ".join(_backends_with(option)) or "none here"
            raise InputError(f"{option}: not an option of backend '{backend}', but of: {others}")
        path = (backend, *understood[option].split("."))
        laid.append(Override(path, value, f"{option} {value}"))
    return load_scenario(scenario, [*overrides, *laid], backends)


def _backends_with(option: str) -> Iterator[str]:
    """Yield the names of the backends that understand an option."""
    for name in REGISTRIES.backends.names():
        try:
            understood = REGISTRIES.backend_options(name).flags
        except InputError:  # a backend that cannot be imported here
            continue
        if option in understood:
            yield name
