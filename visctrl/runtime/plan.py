"""A scenario made definite: every name looked up, every option checked, nothing started."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from visctrl.contracts import Context, Controller, Estimator, ObstacleProvider, Perception
from visctrl.hal.cameras.catalogue import parse_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.files import find_camera
from visctrl.hal.interfaces import Backend, BackendOptions, BackendSetup
from visctrl.robots import Limits, Robot, load_robot
from visctrl.robots.documents import StrictModel, validate
from visctrl.robots.errors import InputError
from visctrl.robots.model import Mount, is_path
from visctrl.runtime.config import (
    CameraChoice,
    CameraError,
    LoadedScenario,
    PluginChoice,
    Scenario,
    Start,
)
from visctrl.runtime.registry import (
    REGISTRIES,
    Registries,
    Registry,
    estimate_type,
    options_type,
)
from visctrl.runtime.safety import effective_limits
from visctrl.runtime.schemes import scheme_named
from visctrl.runtime.target_view import TargetView, load_target
from visctrl.schemes import approach, arrival
from visctrl.schemes.scheme import Scheme

T = TypeVar("T")

#: Time allowed to a run that does not say so: at least this (s); else this (s) and so many times
#: what its way takes at full speed.
_SHORTEST_S, _SPARE_S, _TIMES = 60.0, 30.0, 3.0


@dataclass(frozen=True)
class Chosen(Generic[T]):
    """A plugin class with its checked options, ready to be built."""

    kind: str
    name: str
    cls: type[T]
    options: StrictModel

    def build(self, context: Context) -> T:
        """Return a fresh instance."""
        make: Callable[[StrictModel, Context], T] = self.cls
        return make(self.options, context)

    def effective(self) -> dict[str, Any]:
        """Return name and options, defaults included, as a scenario holds them."""
        return {"name": self.name, **self.options.model_dump(mode="json")}


@dataclass(frozen=True)
class StagePlan:
    """Estimator and controller of one stage of a run, and what tells it of obstacles."""

    estimator: Chosen[Estimator[Any, Any]]
    controller: Chosen[Controller[Any, Any]]
    obstacles: tuple[Chosen[ObstacleProvider[Any, Any]], ...] = ()


@dataclass(frozen=True)
class Plan:
    """What a run is made of.

    camera : the calibration; true_camera : what simulated frames are made with.
    limits : bounds of speed and acceleration, None for an ideal robot.
    target : the target view, None where a simulated robot takes it itself.
    approach : the turn towards the target; None where the run goes without.
    final : the last decimetre by the image; None where the run goes without.
    notes : what the user should know before it starts, a sentence each.
    """

    scenario: Scenario
    backend: type[Backend]
    backend_options: BackendOptions
    robot: Robot
    mount: Mount
    camera: CentralCamera
    true_camera: CentralCamera
    limits: Limits | None
    target: TargetView | None
    perception: Chosen[Perception[Any]]
    approach: StagePlan | None
    final: StagePlan | None
    main: StagePlan
    notes: tuple[str, ...] = ()

    @property
    def scheme(self) -> Scheme:
        """The scheme that the scenario names."""
        return scheme_named(self.scenario.scheme)

    @property
    def period_s(self) -> float:
        """Nominal tick (s)."""
        return 1.0 / self.scenario.rate_hz

    def open_backend(self) -> Backend:
        """Return the backend, not opened yet."""
        setup = BackendSetup(
            robot=self.robot,
            mount=self.mount,
            camera=self.camera,
            true_camera=self.true_camera,
            start=self.scenario.start.pose(),
            limits=self.limits,
            options=self.backend_options,
            seed=self.scenario.seed,
            realtime=self.scenario.realtime,
        )
        return self.backend(setup)

    def context(self, lockstep: bool) -> Context:
        """Return what the plugins are told."""
        return Context(
            camera=self.camera,
            limits=self.limits,
            camera_forward_m=self.mount.forward_m,
            period_s=self.period_s,
            seed=self.scenario.seed,
            lockstep=lockstep,
            body=self.robot.body,
        )

    def effective(self) -> dict[str, Any]:
        """Return the whole configuration, every default filled in; it can be run again."""
        data = self.scenario.model_dump(mode="json", exclude={"backends"})
        if is_path(self.scenario.robot):
            data["robot"] = os.path.realpath(self.scenario.robot)
        data["camera"]["width"] = self.camera.width
        data["camera"]["height"] = self.camera.height
        data["camera"]["mount"] = self.scenario.camera.mount or self.scheme.mount
        data["perception"] = self.perception.effective()
        data["estimator"] = self.main.estimator.effective()
        data["controller"] = self.main.controller.effective()
        data["obstacles"] = [chosen.effective() for chosen in self.main.obstacles]
        for name, stage in (("approach", self.approach), ("final", self.final)):
            if stage is not None:
                data[name]["estimator"] = stage.estimator.effective()
                data[name]["controller"] = stage.controller.effective()
        data[self.scenario.backend] = self.backend_options.model_dump(mode="json")
        return data


def make_plan(loaded: LoadedScenario, registries: Registries = REGISTRIES) -> Plan:
    """Look up every name of a scenario and check every option.

    Raises
    ------
    InputError
        Anything that cannot be run; the message names the file or option and the key.
    """
    scenario = loaded.scenario
    with loaded.looking_up("backend"):
        backend = registries.backends.load(scenario.backend)
    backend_options = _all_backend_options(loaded, registries)
    with loaded.looking_up("robot"):
        robot = load_robot(scenario.robot)
    with loaded.looking_up("scheme"):
        scheme = scheme_named(scenario.scheme)
    with loaded.looking_up("camera", "mount"):
        mount = robot.mount(scenario.camera.mount or scheme.mount)
    with loaded.looking_up("camera"):
        camera = chosen_camera(scenario.camera)
    with loaded.looking_up("camera_error"):
        true_camera = _true(camera, scenario.camera_error)
    limits = effective_limits(robot, scenario.safety, loaded.origin_of("safety"))
    note = ""
    with loaded.looking_up("target", "file"):
        if (target := _target(scenario.target.file, camera)) is not None:
            file = str(scenario.target.file)
            note = target.check_mount(mount, robot.name, scheme, file)
    if scenario.record_images and backend.delivers_features:
        raise InputError(
            f"{loaded.origin_of('record_images')}: key 'record_images': backend "
            f"'{scenario.backend}' takes no pictures"
        )
    perception, turn, main = _plugins(loaded, registries, scheme, backend)
    main = replace(main, obstacles=_providers(loaded, registries, main))
    last = None
    # It backs up without looking: not where something may stand in the way.
    if scenario.final.enabled and not main.obstacles:
        wish, names = scenario.final, (arrival.ESTIMATOR, arrival.CONTROLLER)
        last = _stage(loaded, registries, wish.estimator, wish.controller, names, ("final",))
    if not backend.measures_ranges(robot, backend_options):
        _refuse_listeners(loaded, main)
    if "duration_s" not in scenario.model_fields_set:
        scenario = scenario.model_copy(update={"duration_s": time_allowed(scenario.start, limits)})
    return Plan(
        scenario=scenario,
        backend=backend,
        backend_options=backend_options,
        robot=robot,
        mount=mount,
        camera=camera,
        true_camera=true_camera,
        limits=backend.kept_limits(limits, backend_options),
        target=target,
        perception=perception,
        approach=turn,
        final=last,
        main=main,
        notes=(note,) if note else (),
    )


def time_allowed(start: Start, limits: Limits) -> float:
    """Return how long a run may take (s) that does not say so: by the way and the speed limit.

    The laws turn first, and drive slower the nearer they come.
    """
    way = math.hypot(start.x_m, start.y_m) / limits.v_m_s
    return max(_SHORTEST_S, math.ceil(_SPARE_S + _TIMES * way))


def _plugins(
    loaded: LoadedScenario, registries: Registries, scheme: Scheme, backend: type[Backend]
) -> tuple[Chosen[Perception[Any]], StagePlan | None, StagePlan]:
    scenario = loaded.scenario
    default = scheme.identified if backend.delivers_features else scheme.perception
    perception = choose(
        loaded, registries.perception, scenario.perception, default, ("perception",)
    )
    main = _stage(
        loaded,
        registries,
        scenario.estimator,
        scenario.controller,
        (scheme.estimator, scheme.controller),
        (),
    )
    turn = None
    if scheme.approach and scenario.approach.enabled:
        turn = _stage(
            loaded,
            registries,
            scenario.approach.estimator,
            scenario.approach.controller,
            (approach.ESTIMATOR, approach.CONTROLLER),
            ("approach",),
        )
    return perception, turn, main


def _stage(
    loaded: LoadedScenario,
    registries: Registries,
    estimator_choice: PluginChoice,
    controller_choice: PluginChoice,
    defaults: tuple[str, str],
    path: tuple[str, ...],
) -> StagePlan:
    """Choose a stage's plugins and check that they fit each other."""
    estimator = choose(
        loaded, registries.estimators, estimator_choice, defaults[0], (*path, "estimator")
    )
    controller = choose(
        loaded, registries.controllers, controller_choice, defaults[1], (*path, "controller")
    )
    if problem := misfit(estimator, controller):
        raise InputError(f"{loaded.origin_of(*path)}: {problem}")
    return StagePlan(estimator, controller)


def misfit(estimator: Chosen[Estimator[Any, Any]], controller: Chosen[Controller[Any, Any]]) -> str:
    """Return why a controller does not go with an estimator, empty if it does."""
    given, accepted = estimate_type(estimator.cls), controller.cls.accepts
    if given is None or issubclass(given, accepted):
        return ""
    return (
        f"controller '{controller.name}' needs {accepted.__name__}, estimator '{estimator.name}' "
        f"gives {given.__name__}: choose plugins of one scheme"
    )


def _providers(
    loaded: LoadedScenario, registries: Registries, main: StagePlan
) -> tuple[Chosen[ObstacleProvider[Any, Any]], ...]:
    """Choose what tells the main stage of obstacles, and check that it fits its other plugins."""
    chosen: list[Chosen[ObstacleProvider[Any, Any]]] = []
    for number, choice in enumerate(loaded.scenario.obstacles):
        path = ("obstacles", str(number))
        provider = choose(loaded, registries.obstacles, choice, choice.name, path)
        where = f"{loaded.origin_of(*path)}: {'.'.join(path)}: {provider.kind} '{provider.name}'"
        given, accepted = estimate_type(main.estimator.cls), provider.cls.accepts
        if given is not None and not issubclass(given, accepted):
            raise InputError(
                f"{where} needs {accepted.__name__}, estimator '{main.estimator.name}' gives "
                f"{given.__name__}: choose a scheme that estimates it, such as 'pose'"
            )
        if not main.controller.cls.avoids:
            raise InputError(
                f"{where}: controller '{main.controller.name}' does not avoid obstacles: choose "
                "one that does, such as 'pose-tracking' of the scheme 'pose'"
            )
        if provider.name in (other.name for other in chosen):
            raise InputError(f"{where} is named twice: put all its options in one entry")
        chosen.append(provider)
    return tuple(chosen)


def _refuse_listeners(loaded: LoadedScenario, main: StagePlan) -> None:
    for number, provider in enumerate(main.obstacles):
        if provider.cls.listens:
            path = ("obstacles", str(number))
            raise InputError(
                f"{loaded.origin_of(*path)}: {'.'.join(path)}: {provider.kind} '{provider.name}' "
                f"needs range sensors: robot '{loaded.scenario.robot}' on backend "
                f"'{loaded.scenario.backend}' has none, or they are switched off"
            )


def choose(
    loaded: LoadedScenario,
    registry: Registry[T],
    choice: PluginChoice,
    default: str,
    path: tuple[str, ...],
) -> Chosen[T]:
    """Return the plugin that a choice names, or the default, with its options checked.

    Raises
    ------
    InputError
        No such plugin, or wrong options; the message names the file or option and the key.
    """
    name = choice.name or default
    with loaded.looking_up(*path, "name"):
        cls = registry.load(name)
    origin = f"{loaded.origin_of(*path)}: {'.'.join(path)}"
    options = validate(choice.options, options_type(cls, registry.kind, StrictModel), origin)
    return Chosen(registry.kind, name, cls, options)


def _all_backend_options(loaded: LoadedScenario, registries: Registries) -> BackendOptions:
    """Check the sections of every backend, and return the options of the chosen one."""
    scenario = loaded.scenario
    checked = {}
    for name, section in scenario.backends.items():
        options = registries.backend_options(name)
        checked[name] = validate(section, options, f"{loaded.origin_of(name)}: {name}")
    if scenario.backend in checked:
        return checked[scenario.backend]
    return registries.backend_options(scenario.backend)()


def chosen_camera(choice: CameraChoice) -> CentralCamera:
    """Return the calibration that a scenario's ``camera`` names, in the size it asks for.

    Raises
    ------
    InputError
        No such camera or file, or a size of another shape.
    """
    camera = find_camera(choice.name, choice.cam)
    if choice.width is None and choice.height is None:
        return camera
    width = choice.width or round(camera.width * (choice.height or 0) / camera.height)
    height = choice.height or round(camera.height * width / camera.width)
    return camera.resized(width, height)


def _target(file: str | None, camera: CentralCamera) -> TargetView | None:
    if file is None:
        return None
    view = load_target(Path(file))
    view.check_camera(camera, file)
    return view


def _true(camera: CentralCamera, error: CameraError) -> CentralCamera:
    if error == CameraError():
        return camera
    known = camera.stretched(error.focal_scale, error.focal_scale).model_dump()
    changes = {
        "cx": camera.cx + error.cx_px,
        "cy": camera.cy + error.cy_px,
        "pitch_deg": camera.pitch_deg + error.tilt_deg,
        "roll_deg": camera.roll_deg + error.roll_deg,
        "yaw_deg": camera.yaw_deg + error.yaw_deg,
    }
    if error.xi != 0.0:
        changes["xi"] = known.get("xi", 0.0) + error.xi
    return parse_camera({**known, **changes}, "the true camera")
