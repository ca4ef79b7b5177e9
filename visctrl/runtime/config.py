"""Scenarios: what to run, from where, with what, as YAML.

Every key has a default, so a scenario names only what is special about it. Overrides come in
layers, each checked as it is laid on, so that an error names the layer that holds it.
"""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import ConfigDict, Field

from visctrl.hal.types import Pose
from visctrl.robots.documents import StrictModel, read_yaml, suggestion, validate
from visctrl.robots.errors import InputError
from visctrl.robots.plain_yaml import YamlError, load_plain

DEFAULT_SCENARIO = "default"

Positive = Annotated[float, Field(gt=0.0)]
Metres = Annotated[float, Field(ge=-100.0, le=100.0)]
Degrees = Annotated[float, Field(ge=-360.0, le=360.0)]
#: Keys of a plugin or backend, checked by its own options once it is chosen.
Section = dict[str, Any]


class PluginChoice(StrictModel):
    """A plugin by name, and its options beside the name.

    Without a name, the scheme's plugin is meant.
    """

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False)

    name: str | None = None

    @property
    def options(self) -> dict[str, Any]:
        """The keys that belong to the plugin."""
        return dict(self.__pydantic_extra__ or {})


class ProviderChoice(PluginChoice):
    """An obstacle provider; there is none that a name could be left out for."""

    name: str


class CameraChoice(StrictModel):
    """Which camera the robot carries, and where.

    name : of a built-in camera, or the path of a calibration.
    cam : which camera, of a calibration that holds several.
    width, height : image size (px); the camera's own if left out, and one follows from the other.
    mount : name of one of the robot's mounts; the scheme's own if left out.
    """

    name: str = "hypercatadioptric"
    cam: Annotated[int, Field(ge=0)] | None = None
    width: Annotated[int, Field(gt=0, le=10_000)] | None = None
    height: Annotated[int, Field(gt=0, le=10_000)] | None = None
    mount: str | None = None


class CameraError(StrictModel):
    """By how much the true camera differs from the calibration (simulated backends only).

    focal_scale : true focal length over the assumed one.
    cx_px, cy_px, xi : true minus assumed projection centre and mirror parameter.
    tilt_deg, roll_deg, yaw_deg : misalignment of the camera about the robot's right, forward and
        upward axis.
    """

    focal_scale: Positive = 1.0
    cx_px: float = 0.0
    cy_px: float = 0.0
    xi: float = 0.0
    tilt_deg: Degrees = 0.0
    roll_deg: Degrees = 0.0
    yaw_deg: Degrees = 0.0


class Start(StrictModel):
    """Start pose of the camera in the target's frame: x right, y forward, φ counter-clockwise."""

    x_m: Metres = -0.55
    y_m: Metres = -1.35
    phi_deg: Degrees = -35.0

    def pose(self) -> Pose:
        """Return the pose in metres and radians."""
        return Pose(self.x_m, self.y_m, math.radians(self.phi_deg))


class Target(StrictModel):
    """Where the target view comes from.

    file : a view made by ``visctrl teach``; without it a simulated robot visits the target.
    frames : how many frames it takes there.
    """

    file: str | None = None
    frames: Annotated[int, Field(ge=1, le=1000)] = 1


class Approach(StrictModel):
    """Turning on the spot before the main stage, when the robot does not head at the target.

    timeout_s : give up turning after this long.
    settle_s : longest wait for standstill afterwards.
    """

    enabled: bool = True
    estimator: PluginChoice = PluginChoice()
    controller: PluginChoice = PluginChoice()
    timeout_s: Positive = 30.0
    settle_s: Positive = 2.0


class Final(StrictModel):
    """The last decimetre by the image, where the arrival check finds something left.

    within_m : farther off it does nothing. timeout_s : give up after this long.
    """

    enabled: bool = True
    estimator: PluginChoice = PluginChoice()
    controller: PluginChoice = PluginChoice()
    within_m: Positive = 0.45
    timeout_s: Positive = 150.0


class SafetyOptions(StrictModel):
    """Bounds that hold for every run.

    v_m_s, omega_deg_s, acceleration_m_s2, angular_acceleration_deg_s2 : in place of the robot's
        operating limits; never above its hardware's.
    max_frame_age_s : an older frame is no view of the present.
    frozen_timeout_s : a camera that delivers nothing newer for this long has failed.
    lost_timeout_s : the robot waits this long at a standstill for lost features to come back.
    max_command_age_s : a command is withdrawn when no newer one follows for this long.
    """

    v_m_s: Positive | None = None
    omega_deg_s: Positive | None = None
    acceleration_m_s2: Positive | None = None
    angular_acceleration_deg_s2: Positive | None = None
    max_frame_age_s: Positive = 0.5
    frozen_timeout_s: Positive = 3.0
    lost_timeout_s: Positive = 5.0
    max_command_age_s: Positive = 0.5


class Tolerance(StrictModel):
    """How close to the target counts as reached, where the truth is known."""

    position_m: Positive = 0.02
    heading_deg: Positive = 1.0


class Scenario(StrictModel):
    """Everything that a run depends on."""

    title: str = ""
    backend: str = "sim"
    scheme: str = "trifocal"
    robot: str = "p3dx"
    camera: CameraChoice = CameraChoice()
    camera_error: CameraError = CameraError()
    start: Start = Start()
    target: Target = Target()
    #: Longest time of the main stage; where it is left out, longer for a far start (see `Plan`).
    duration_s: Annotated[float, Field(gt=0.0, le=100_000.0)] = 60.0
    rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = 10.0
    seed: Annotated[int, Field(ge=0)] = 0
    realtime: bool = False
    #: Keep every frame of the run, for ``visctrl replay``.
    record_images: bool = False
    perception: PluginChoice = PluginChoice()
    estimator: PluginChoice = PluginChoice()
    controller: PluginChoice = PluginChoice()
    obstacles: tuple[ProviderChoice, ...] = ()
    approach: Approach = Approach()
    final: Final = Final()
    safety: SafetyOptions = SafetyOptions()
    tolerance: Tolerance = Tolerance()
    #: Options of the backends, by the backend's name.
    backends: dict[str, Section] = Field(default_factory=dict)


@dataclass(frozen=True)
class Override:
    """One value laid over a scenario.

    path : keys from the top, e.g. ``("controller", "tau_s")``.
    origin : the option that asked for it, for error messages.
    """

    path: tuple[str, ...]
    value: Any
    origin: str


@dataclass(frozen=True)
class LoadedScenario:
    """A scenario, and where its parts came from.

    origin : file of the scenario.
    data : the keys that file and overrides give, without defaults.
    """

    scenario: Scenario
    origin: str
    data: dict[str, Any]
    overrides: tuple[Override, ...] = ()

    def origin_of(self, *path: str) -> str:
        """Return where the value at ``path`` came from: the file, options, or both."""
        origins = [self.origin]
        for override in self.overrides:
            if override.path == path[: len(override.path)]:
                origins = [override.origin]
            elif override.path[: len(path)] == path:
                origins.append(override.origin)
        return ", ".join(origins)

    @contextmanager
    def looking_up(self, *path: str) -> Iterator[None]:
        """Have an `InputError` inside told with the file or option and the key at ``path``."""
        try:
            yield
        except InputError as error:
            key = ".".join(path)
            raise InputError(f"{self.origin_of(*path)}: key '{key}': {error}") from error


@cache
def scenario_names() -> tuple[str, ...]:
    """Return the names of the scenarios that this package holds."""
    files = resources.files("visctrl.configs").iterdir()
    return tuple(sorted(f.name.removesuffix(".yaml") for f in files if f.name.endswith(".yaml")))


def parse_setting(text: str) -> Override:
    """Return the override that ``--set key.key=value`` asks for; the value is YAML.

    Raises
    ------
    InputError
        No ``=``, an empty key, or a value that is not YAML.
    """
    key, equals, value = text.partition("=")
    path = tuple(key.strip().split("."))
    origin = f"--set {text}"
    if not equals or not all(path):
        raise InputError(f"{origin}: expected key=value with a dotted key, as in seed=3")
    try:
        return Override(path, load_plain(value), origin)
    except YamlError as error:
        raise InputError(f"{origin}: the value '{value}' is not valid YAML: {error}") from None


def load_scenario(
    name: str = DEFAULT_SCENARIO,
    overrides: Iterable[Override] = (),
    backend_names: Iterable[str] = (),
) -> LoadedScenario:
    """Read a scenario by name or path and lay the overrides on it, in order.

    Parameters
    ----------
    name : str
        A built-in scenario, or the path of a YAML file.
    overrides : iterable of Override
        Later ones win.
    backend_names : iterable of str
        Top-level keys that hold the options of a backend.

    Raises
    ------
    InputError
        The file or an override cannot be used; the message names it, the key and what was
        expected.
    """
    source = scenario_source(name)
    return scenario_from(read_yaml(source), str(source), overrides, backend_names)


def scenario_from(
    data: Mapping[str, Any],
    origin: str,
    overrides: Iterable[Override] = (),
    backend_names: Iterable[str] = (),
) -> LoadedScenario:
    """Check a scenario that is already read and lay overrides on it (see `load_scenario`).

    Parameters
    ----------
    data : mapping
        The keys of the scenario; left as they are.
    origin : str
        Where they came from, for error messages.
    """
    backends = frozenset(backend_names)
    laid = copy.deepcopy(dict(data))
    scenario = _checked(laid, origin, backends)
    overrides = tuple(overrides)
    for override in overrides:
        _lay(laid, override)
        scenario = _checked(laid, override.origin, backends)
    return LoadedScenario(scenario, origin, laid, overrides)


def overlaid(data: Mapping[str, Any], overrides: Iterable[Override]) -> dict[str, Any]:
    """Return a copy of a scenario's keys with overrides laid on, not checked.

    Raises
    ------
    InputError
        An override looks for a mapping where there is a value.
    """
    laid = copy.deepcopy(dict(data))
    for override in overrides:
        _lay(laid, override)
    return laid


def to_yaml(data: Mapping[str, Any]) -> str:
    """Return a mapping as YAML text, in the order of its keys."""
    return yaml.safe_dump(dict(data), sort_keys=False, allow_unicode=True)


def scenario_title(name: str) -> str:
    """Return the title of a built-in scenario."""
    return str(read_yaml(resources.files("visctrl.configs") / f"{name}.yaml").get("title", ""))


def scenario_source(name: str) -> Path | Traversable:
    """Return the file of a scenario, given by name or path.

    Raises
    ------
    InputError
        It is neither a built-in scenario nor a path.
    """
    if name in scenario_names():
        return resources.files("visctrl.configs") / f"{name}.yaml"
    path = Path(name)
    if os.path.isdir(path):
        path = path / "config.yaml"
    if path.suffix in {".yaml", ".yml"} or os.path.exists(path):
        return path
    raise InputError(f"unknown scenario '{name}'; {suggestion(name, scenario_names())}")


def _checked(data: dict[str, Any], origin: str, backends: frozenset[str]) -> Scenario:
    """Validate with the backends' sections gathered under one key.

    A backend that is named by ``module:Class`` has its section under just that name.
    """
    chosen = data.get("backend")
    if isinstance(chosen, str) and ":" in chosen:
        backends = backends | {chosen}
    inner = {key: value for key, value in data.items() if key not in backends}
    sections = {key: data[key] for key in data if key in backends}
    for key, value in sections.items():
        if not isinstance(value, dict):
            raise InputError(f"{origin}: key '{key}': expected a mapping of keys (got {value!r})")
    if "backends" in inner:
        raise InputError(f"{origin}: unknown key 'backends'; {suggestion('backend', _keys())}")
    return validate({**inner, "backends": sections}, Scenario, origin)


def _keys() -> list[str]:
    return [key for key in Scenario.model_fields if key != "backends"]


def _lay(data: dict[str, Any], override: Override) -> None:
    *parents, last = override.path
    here = data
    for depth, key in enumerate(parents, start=1):
        inner = here.setdefault(key, {})
        if not isinstance(inner, dict):
            dotted = ".".join(override.path[:depth])
            raise InputError(f"{override.origin}: key '{dotted}' holds a value, not a mapping")
        here = inner
    here[last] = copy.deepcopy(override.value)
