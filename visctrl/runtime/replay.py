"""Perception and estimation once more over recorded images, without a robot."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from visctrl.contracts import Context, Decision, Estimator, Perception, Plugin, Views
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Frame, Odometry
from visctrl.robots import Robot, load_robot
from visctrl.robots.errors import InputError, VisctrlError
from visctrl.robots.files import owner_only, writing
from visctrl.robots.model import Mount
from visctrl.runtime.config import LoadedScenario, Override, Scenario, load_scenario, to_yaml
from visctrl.runtime.images import INITIAL
from visctrl.runtime.loop import PluginError
from visctrl.runtime.meter import Meter
from visctrl.runtime.plan import Chosen, choose, chosen_camera
from visctrl.runtime.recorder import CONFIG, Recorder
from visctrl.runtime.recording import Driven, Recording, Shot, read_image
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.registry import REGISTRIES, Registries
from visctrl.runtime.run_directory import RunDirectory
from visctrl.runtime.safety import effective_limits
from visctrl.runtime.scheduler import Tick
from visctrl.runtime.schemes import APPROACH_ESTIMATOR, scheme_named
from visctrl.runtime.summary import versions
from visctrl.threads import one_thread_of_algebra
from visctrl.viewers.run_pictures import Pictures

T = TypeVar("T")

#: Sections whose options belong to the plugin that they name.
_SECTIONS = (
    ("perception",),
    ("estimator",),
    ("controller",),
    ("approach", "estimator"),
    ("approach", "controller"),
)


@dataclass(frozen=True)
class ReplayPlan:
    """What runs over the images.

    estimators : by stage.
    """

    scenario: Scenario
    robot: Robot
    mount: Mount
    camera: CentralCamera
    context: Context
    perception: Chosen[Perception[Any]]
    estimators: Mapping[str, Chosen[Estimator[Any, Any]]]

    def effective(self) -> dict[str, Any]:
        """Return the configuration with every default filled in."""
        data = self.scenario.model_dump(mode="json", exclude={"backends"})
        data["perception"] = self.perception.effective()
        data["estimator"] = self.estimators["main"].effective()
        data["approach"]["estimator"] = self.estimators["approach"].effective()
        return data


def load_for_replay(recording: Recording, overrides: Sequence[Override]) -> LoadedScenario:
    """Return the scenario that the images were taken in, with changes laid on it.

    To name another plugin or scheme drops the recorded options of those that it replaces.

    Raises
    ------
    InputError
        See `load_scenario`.
    """
    backends = REGISTRIES.backends.known()
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


def plan_replay(loaded: LoadedScenario, registries: Registries = REGISTRIES) -> ReplayPlan:
    """Look up perception and estimators, and check their options.

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
    turn = choose(loaded, kinds, scenario.approach.estimator, APPROACH_ESTIMATOR, path)
    perception = choose(
        loaded, registries.perception, scenario.perception, scheme.perception, ("perception",)
    )
    estimators = {"main": main, "approach": turn}
    return ReplayPlan(scenario, robot, mount, camera, context, perception, estimators)


def replay(
    recording: Recording,
    plan: ReplayPlan,
    out: Path | RunDirectory | None,
    *,
    video: bool = False,
    observers: Sequence[Observer] = (),
) -> dict[str, Any]:
    """Run perception and estimation over the images; return a summary.

    The files are those of a run. What was sent, the true pose and the odometry are the
    recording's; a plain folder of images has none.

    Raises
    ------
    InputError
        An image cannot be used (the message names it). Nothing is left behind.
    PluginError
        A plugin raised an exception.
    DiskError
        The files cannot be written.
    """
    directory = RunDirectory(out) if isinstance(out, Path) else out
    shared = directory is not None and directory.shared
    with one_thread_of_algebra(), owner_only(unless=shared):
        return _Replay(recording, plan, directory, video, observers).run()


class _Replay:
    def __init__(
        self,
        recording: Recording,
        plan: ReplayPlan,
        directory: RunDirectory | None,
        video: bool,
        observers: Sequence[Observer],
    ) -> None:
        self._recording, self._plan, self._video = recording, plan, video
        self._directory = directory
        self._meter = Meter()
        self._observers: list[Observer] = [self._meter, *observers]
        self._plugins: list[Plugin[Any]] = []
        self._recorder: Recorder | None = None
        self._pictures: Pictures | None = None
        self._health = {"views": Counter[str](), "estimate": Counter[str]()}
        self._last: Driven | None = None

    def run(self) -> dict[str, Any]:
        directory = self._directory
        if directory is None:
            return self._replayed()
        try:
            with writing(directory.path):
                summary = self._replayed()
                directory.release_reserve()
                directory.write_summary(summary)
                if self._pictures is not None:
                    self._pictures.finish()
                    self._pictures.report()
        except InputError:
            directory.discard()
            raise
        finally:
            directory.close()
        return summary

    def _replayed(self) -> dict[str, Any]:
        """Replay everything; return the summary."""
        try:
            self._play()
        finally:
            self._close()
        return self._summary()

    def _play(self) -> None:
        plan = self._plan
        self._perception = self._build(plan.perception)
        stages = {shot.driven.stage for shot in self._recording.shots if shot.driven}
        self._estimators = {
            stage: self._build(plan.estimators[stage]) for stage in sorted(stages | {"main"})
        }
        self._start_recording()
        self._take_target()
        for shot in self._recording.shots:
            frame = Frame(shot.stamp, shot.sequence, read_image(shot.path, plan.camera))
            if shot.role == INITIAL:
                self._take_initial(frame, shot.path)
            elif shot.driven is not None:
                self._tick(frame, shot, shot.driven)

    def _start_recording(self) -> None:
        if self._directory is None:
            return
        self._directory.write_text(CONFIG, to_yaml(self._plan.effective()))
        self._pictures = Pictures(self._plan, self._directory)
        self._observers.append(self._pictures)
        if self._video:
            self._pictures.start_video(lockstep=True)
        named: list[tuple[str, Plugin[Any]]] = [(self._plan.perception.name, self._perception)]
        for stage, estimator in self._estimators.items():
            named.append((self._plan.estimators[stage].name, estimator))
        self._recorder = Recorder(self._directory.path, named, lockstep=True)
        self._observers.append(self._recorder)

    def _take_target(self) -> None:
        frames = self._recording.target
        try:
            self._call(self._perceiver, lambda: self._perception.set_target(frames))
        except InputError as error:
            raise InputError(f"{self._recording.target_origin}: {error}") from error
        for observer in self._observers:
            observer.on_target(frames)

    def _take_initial(self, frame: Frame, path: Path) -> None:
        try:
            match = self._call(self._perceiver, lambda: self._perception.set_initial(frame))
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        for observer in self._observers:
            observer.on_initial(frame, match)
        self._last = None

    def _tick(self, frame: Frame, shot: Shot, driven: Driven) -> None:
        estimator = self._estimators[driven.stage]
        name = self._plan.estimators[driven.stage].name
        if self._last is None or driven.stage != self._last.stage:
            self._call(f"estimator '{name}'", estimator.reset)
            for observer in self._observers:
                observer.on_stage(driven.stage)
        dt = self._since_last(driven)
        began = time.perf_counter()
        if shot.age > self._plan.scenario.safety.max_frame_age_s:
            views = Views.nothing(frame.stamp, f"frame is {shot.age:.2f} s old")
        else:
            views = self._call(self._perceiver, lambda: self._perception.update(frame))
        seen = time.perf_counter()
        estimate = self._call(
            f"estimator '{name}'", lambda: estimator.update(views, driven.before, dt)
        )
        done = time.perf_counter()
        self._last = driven
        self._health["views"][views.health] += 1
        self._health["estimate"][estimate.health] += 1
        record = TickRecord(
            number=driven.number,
            t=driven.t,
            stage=driven.stage,
            tick=Tick(frame.stamp + shot.age, dt, 0.0, 0, 0),
            frame=frame,
            views=views,
            estimate=estimate,
            decision=Decision(driven.wanted, driven.phase),
            sent=driven.sent,
            odometry=Odometry(frame.stamp, driven.odometry, driven.measured),
            truth=driven.truth,
            battery_v=driven.battery_v,
            event=driven.event,
            blame="",
            signals=self._signals(name, estimator),
            seconds=(0.0, seen - began, done - seen, 0.0, 0.0),
        )
        for observer in self._observers:
            observer.on_tick(record)

    def _since_last(self, driven: Driven) -> float:
        """Return the time since the last frame replayed: images may be missing in between."""
        last = self._last
        if last is None or last.stage != driven.stage or last.number + 1 == driven.number:
            return driven.dt
        return driven.t - last.t

    def _signals(
        self, name: str, estimator: Estimator[Any, Any]
    ) -> tuple[tuple[str, Mapping[str, float]], ...]:
        plugins: tuple[tuple[str, Plugin[Any]], ...] = (
            (self._plan.perception.name, self._perception),
            (name, estimator),
        )
        return tuple((who, dict(plugin.values())) for who, plugin in plugins if plugin.signals)

    def _summary(self) -> dict[str, Any]:
        plan, meter = self._plan, self._meter
        return {
            "status": "replayed",
            "source": str(self._recording.source),
            "perception": plan.perception.name,
            "estimator": plan.estimators["main"].name,
            "camera": plan.camera.name,
            "seed": plan.scenario.seed,
            "ticks": meter.main_ticks,
            "features": meter.features(),
            "health": {kind: dict(counts) for kind, counts in self._health.items()},
            "stages_ms": {kind: meter.spread_ms(kind) for kind in ("perception", "estimation")},
            "versions": versions(),
        }

    @property
    def _perceiver(self) -> str:
        return f"perception '{self._plan.perception.name}'"

    def _build(self, chosen: Chosen[T]) -> T:
        who = f"{chosen.kind} '{chosen.name}'"
        plugin = self._call(who, lambda: chosen.build(self._plan.context))
        if isinstance(plugin, Plugin):
            self._plugins.append(plugin)
        return plugin

    def _call(self, who: str, work: Callable[[], T]) -> T:
        try:
            return work()
        except VisctrlError:
            raise
        except Exception as error:
            raise PluginError(who, error) from error

    def _close(self) -> None:
        while self._plugins:
            self._plugins.pop().close()
        if self._recorder is not None:
            self._recorder.close()
            self._recorder = None


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
