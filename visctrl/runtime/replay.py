"""The plugins once more over recorded images, without a robot: open loop."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from visctrl.contracts import Controller, Decision, Estimate, Match, Plugin
from visctrl.hal.types import Frame, Odometry, Velocity
from visctrl.robots.documents import StrictModel
from visctrl.robots.errors import InputError
from visctrl.robots.files import owner_only, writing
from visctrl.runtime.config import to_yaml
from visctrl.runtime.images import INITIAL
from visctrl.runtime.meter import Meter
from visctrl.runtime.pipeline import Pipeline, Stage, Watch, call_plugin, signals_of
from visctrl.runtime.plan import Chosen
from visctrl.runtime.recorder import CONFIG, Recorder
from visctrl.runtime.recording import Driven, Recording, Shot, read_image
from visctrl.runtime.records import COMPUTE, Observer, TickRecord
from visctrl.runtime.replay_plan import ReplayPlan
from visctrl.runtime.run_directory import RunDirectory
from visctrl.runtime.scheduler import Tick
from visctrl.runtime.summary import versions
from visctrl.threads import one_thread_of_algebra

T = TypeVar("T")


def replay(
    recording: Recording,
    plan: ReplayPlan,
    out: Path | RunDirectory | None,
    *,
    observers: Sequence[Observer] = (),
) -> dict[str, Any]:
    """Run the plugins over the images; return a summary.

    The files are those of a run. The controller runs open loop: it hears what was sent then, and
    what it decides is recorded and goes nowhere. What was sent, the true pose and the odometry are
    the recording's; a plain folder of images has none.

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
        return _Replay(recording, plan, directory, observers).run()


class _Times(Watch):
    """Times the parts of a tick."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self._mark = 0.0

    def begin(self) -> None:
        """Start a tick."""
        self.seconds, self._mark = [], time.perf_counter()

    def after(self, part: str) -> None:
        """End a part of it."""
        now = time.perf_counter()
        self.seconds.append(now - self._mark)
        self._mark = now


class _Undecided(Controller[StrictModel, Estimate]):
    """Stands in where no controller goes with the estimator."""

    Options: ClassVar[type[StrictModel]] = StrictModel
    accepts: ClassVar[type[Estimate]] = Estimate

    def update(self, estimate: Estimate, sent: Velocity, dt: float) -> Decision:
        """Decide nothing."""
        return Decision()


class _Replay:
    def __init__(
        self,
        recording: Recording,
        plan: ReplayPlan,
        directory: RunDirectory | None,
        observers: Sequence[Observer],
    ) -> None:
        self._recording, self._plan = recording, plan
        self._directory = directory
        self._meter = Meter()
        self._watchers = tuple(observers)
        self._observers: list[Observer] = [self._meter, *self._watchers]
        self._plugins: list[Plugin[Any]] = []
        self._recorder: Recorder | None = None
        self._health = {"views": Counter[str](), "estimate": Counter[str]()}
        self._last: Driven | None = None
        self._pipeline: Pipeline | None = None
        self._times = _Times()

    def run(self) -> dict[str, Any]:
        directory = self._directory
        if directory is None:
            summary = self._replayed()
            self._dismiss()
            return summary
        try:
            with writing(directory.path):
                summary = self._replayed()
                directory.release_reserve()
                directory.write_summary(summary)
                self._dismiss()
        except InputError:
            directory.discard()
            raise
        finally:
            directory.close()
        return summary

    def _dismiss(self) -> None:
        for watcher in self._watchers:
            watcher.on_end()

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
        self._stages = {stage: self._stage(stage) for stage in sorted(stages | {"main"})}
        self._start_recording()
        self._take_target()
        for shot in self._recording.shots:
            frame = Frame(shot.stamp, shot.sequence, read_image(shot.path, plan.camera))
            if shot.role == INITIAL:
                self._take_initial(frame, shot.path)
            elif shot.driven is not None:
                self._tick(frame, shot, shot.driven)

    def _start_recording(self) -> None:
        for watcher in self._watchers:
            watcher.on_begin(lockstep=True)
        if self._directory is None:
            return
        self._directory.write_text(CONFIG, to_yaml(self._plan.effective()))
        named: list[tuple[str, Plugin[Any]]] = [(self._plan.perception.name, self._perception)]
        for stage in self._stages.values():
            named.append((stage.estimator_name, stage.estimator))
            named.append((stage.controller_name, stage.controller))
        self._recorder = Recorder(self._directory.path, named, lockstep=True)
        self._observers.append(self._recorder)

    def _take_target(self) -> None:
        frames = self._recording.target
        try:
            call_plugin(self._perceiver, lambda: self._perception.set_target(frames))
        except InputError as error:
            raise InputError(f"{self._recording.target_origin}: {error}") from error
        for observer in self._observers:
            observer.on_target(frames)

    def _take_initial(self, frame: Frame, path: Path) -> None:
        try:
            match = call_plugin(self._perceiver, lambda: self._perception.set_initial(frame), Match)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        for observer in self._observers:
            observer.on_initial(frame, match)
        self._last = None

    def _tick(self, frame: Frame, shot: Shot, driven: Driven) -> None:
        pipeline = self._pipeline
        if self._last is None or pipeline is None or driven.stage != self._last.stage:
            pipeline = self._begin_stage(driven)
        problem = ""
        if shot.age > self._plan.scenario.safety.max_frame_age_s:
            problem = f"frame is {shot.age:.2f} s old"
        dt = self._since_last(driven)
        pipeline.sent = driven.before
        self._times.begin()
        views, estimate = pipeline.tick(frame, problem, dt)
        pipeline.was_sent(driven.sent)
        self._last = driven
        self._health["views"][views.health] += 1
        self._health["estimate"][estimate.health] += 1
        deciding = self._plan.controllers[driven.stage] is not None
        record = TickRecord(
            number=driven.number,
            t=driven.t,
            stage=driven.stage,
            tick=Tick(frame.stamp + shot.age, dt, 0.0, 0, 0),
            frame=frame,
            views=views,
            estimate=estimate,
            decision=pipeline.decision if deciding else Decision(driven.wanted, driven.phase),
            sent=driven.sent,
            odometry=Odometry(frame.stamp, driven.odometry, driven.measured),
            truth=driven.truth,
            battery_v=driven.battery_v,
            event=driven.event,
            blame="",
            signals=tuple(signals_of(pipeline.reporting())),
            seconds=(0.0, *self._times.seconds, 0.0),
        )
        for observer in self._observers:
            observer.on_tick(record)

    def _begin_stage(self, driven: Driven) -> Pipeline:
        stage = self._stages[driven.stage]
        call_plugin(f"estimator '{stage.estimator_name}'", stage.estimator.reset)
        for observer in self._observers:
            observer.on_stage(stage.name)
        self._pipeline = Pipeline(self._perception, self._plan.perception.name, stage, self._times)
        return self._pipeline

    def _stage(self, name: str) -> Stage:
        estimator, law = self._plan.estimators[name], self._plan.controllers[name]
        controller: Controller[Any, Any] = _Undecided(StrictModel(), self._plan.context)
        if law is not None:
            controller = self._build(law)
        named = "none" if law is None else law.name
        return Stage(name, self._build(estimator), controller, estimator.name, named, math.inf)

    def _since_last(self, driven: Driven) -> float:
        """Return the time since the last frame replayed: images may be missing in between."""
        last = self._last
        if last is None or last.stage != driven.stage or last.number + 1 == driven.number:
            return driven.dt
        return driven.t - last.t

    def _summary(self) -> dict[str, Any]:
        plan, meter = self._plan, self._meter
        return {
            "status": "replayed",
            "source": str(self._recording.source),
            "perception": plan.perception.name,
            "estimator": plan.estimators["main"].name,
            "controller": law.name if (law := plan.controllers["main"]) is not None else None,
            "camera": plan.camera.name,
            "seed": plan.scenario.seed,
            "ticks": meter.main_ticks,
            "features": meter.features(),
            "health": {kind: dict(counts) for kind, counts in self._health.items()},
            "stages_ms": {kind: meter.spread_ms(kind) for kind in COMPUTE},
            "versions": versions(),
        }

    @property
    def _perceiver(self) -> str:
        return f"perception '{self._plan.perception.name}'"

    def _build(self, chosen: Chosen[T]) -> T:
        who = f"{chosen.kind} '{chosen.name}'"
        plugin = call_plugin(who, lambda: chosen.build(self._plan.context))
        if isinstance(plugin, Plugin):
            self._plugins.append(plugin)
        return plugin

    def _close(self) -> None:
        for watcher in self._watchers:
            watcher.close()
        while self._plugins:
            self._plugins.pop().close()
        if self._recorder is not None:
            self._recorder.close()
            self._recorder = None
