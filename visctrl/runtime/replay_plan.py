"""What a replay is made of: the recorded scenario with changes laid on it, and its plugins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from visctrl.contracts import Context, Controller, Estimator, Perception
from visctrl.hal.cameras.central import CentralCamera
from visctrl.robots import Robot, load_robot
from visctrl.robots.errors import InputError
from visctrl.robots.model import Mount
from visctrl.runtime.config import LoadedScenario, Override, Scenario, load_scenario
from visctrl.runtime.plan import Chosen, choose, chosen_camera, misfit
from visctrl.runtime.recording import Recording
from visctrl.runtime.registry import REGISTRIES, Registries
from visctrl.runtime.safety import effective_limits
from visctrl.runtime.schemes import scheme_named
from visctrl.schemes import approach, arrival

#: Sections whose options belong to the plugin that they name.
_SECTIONS = (
    ("perception",),
    ("estimator",),
    ("controller",),
    ("approach", "estimator"),
    ("approach", "controller"),
    ("final", "estimator"),
    ("final", "controller"),
)


@dataclass(frozen=True)
class ReplayPlan:
    """What runs over the images.

    estimators, controllers : by stage; None where no controller goes with the estimator.
    """

    scenario: Scenario
    robot: Robot
    mount: Mount
    camera: CentralCamera
    context: Context
    perception: Chosen[Perception[Any]]
    estimators: Mapping[str, Chosen[Estimator[Any, Any]]]
    controllers: Mapping[str, Chosen[Controller[Any, Any]] | None]

    def effective(self) -> dict[str, Any]:
        """Return the configuration with every default filled in."""
        data = self.scenario.model_dump(mode="json", exclude={"backends"})
        data["perception"] = self.perception.effective()
        data["estimator"] = self.estimators["main"].effective()
        data["approach"]["estimator"] = self.estimators["approach"].effective()
        data["final"]["estimator"] = self.estimators["final"].effective()
        if (controller := self.controllers["main"]) is not None:
            data["controller"] = controller.effective()
        for stage in ("approach", "final"):
            if (controller := self.controllers[stage]) is not None:
                data[stage]["controller"] = controller.effective()
        return data


def load_for_replay(recording: Recording, overrides: Sequence[Override]) -> LoadedScenario:
    """Return the scenario that the images were taken in, with changes laid on it.

    To name another plugin or scheme drops the recorded options of those that it replaces.

    Raises
    ------
    InputError
        See `load_scenario`.
    """
    backends = REGISTRIES.backends.names()
    first: list[Override] = []
    if recording.camera is not None:
        origin = str(recording.camera)
        first.append(Override(("camera", "name"), str(recording.camera), origin))
    if recording.config is None:
        return load_scenario(overrides=[*first, *overrides], backend_names=backends)
    name = str(recording.config)
    recorded = load_scenario(name, (), backends).data
    laid = [fresh for override in overrides for fresh in _replacing(override, recorded)]
    return load_scenario(name, [*first, *laid], backends)


def plan_replay(
    loaded: LoadedScenario,
    registries: Registries = REGISTRIES,
    *,
    recorded: bool = True,
    named: bool = False,
) -> ReplayPlan:
    """Look up the plugins and check their options.

    recorded : whether the images are those of a run; nobody drove through a plain folder, and a
        controller decides there only if it is asked for.
    named : whether the user has named the controller, which then must go with the estimator; that
        of the recording is left out where it does not.

    Raises
    ------
    InputError
        Anything that cannot be used; the message names the file or option and the key.
    """
    scenario = loaded.scenario
    scheme = scheme_named(scenario.scheme)
    camera = chosen_camera(scenario.camera)
    robot = load_robot(scenario.robot)
    mount = robot.mount(scenario.camera.mount or scheme.mount)
    context = Context(
        camera=camera,
        limits=effective_limits(robot, scenario.safety, loaded.origin_of("safety")),
        camera_forward_m=mount.forward_m,
        period_s=1.0 / scenario.rate_hz,
        seed=scenario.seed,
        lockstep=True,
        body=robot.body,
    )
    kinds = registries.estimators
    main = choose(loaded, kinds, scenario.estimator, scheme.estimator, ("estimator",))
    path = ("approach", "estimator")
    turn = choose(loaded, kinds, scenario.approach.estimator, approach.ESTIMATOR, path)
    perception = choose(
        loaded, registries.perception, scenario.perception, scheme.perception, ("perception",)
    )
    path = ("final", "estimator")
    last = choose(loaded, kinds, scenario.final.estimator, arrival.ESTIMATOR, path)
    laws: dict[str, Chosen[Controller[Any, Any]] | None]
    laws = {"main": None, "approach": None, "final": None}
    if recorded or named:
        steer = registries.controllers
        law = choose(loaded, steer, scenario.controller, scheme.controller, ("controller",))
        path = ("approach", "controller")
        faces = choose(loaded, steer, scenario.approach.controller, approach.CONTROLLER, path)
        if named and (problem := misfit(main, law)):
            raise InputError(f"{loaded.origin_of('controller', 'name')}: {problem}")
        laws["main"] = None if misfit(main, law) else law
        laws["approach"] = None if misfit(turn, faces) else faces
        path = ("final", "controller")
        closes = choose(loaded, steer, scenario.final.controller, arrival.CONTROLLER, path)
        laws["final"] = None if misfit(last, closes) else closes
    estimators = {"main": main, "approach": turn, "final": last}
    return ReplayPlan(scenario, robot, mount, camera, context, perception, estimators, laws)


def _replacing(override: Override, recorded: Mapping[str, Any]) -> list[Override]:
    """Return an override, after one that clears the options of a plugin that it replaces."""
    if override.path == ("scheme",) and override.value != recorded.get("scheme"):
        cleared = [Override(path, {}, override.origin) for path in _SECTIONS[:3]]
        return [*cleared, override]
    section, key = override.path[:-1], override.path[-1]
    if section in _SECTIONS and key == "name":
        here: Any = recorded
        for part in section:
            here = here.get(part, {})
        if here.get("name") != override.value:
            return [Override(section, {"name": override.value}, override.origin)]
    return [override]
