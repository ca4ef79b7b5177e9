"""A run from opening the backend to the files it leaves: target view, approach, main stage."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from visctrl.contracts import Context, Match, Perception, Plugin
from visctrl.hal.actuation import Limiter
from visctrl.hal.interfaces import Backend
from visctrl.hal.types import Pose
from visctrl.robots.errors import DiskError, InputError
from visctrl.robots.files import owner_only, writing
from visctrl.runtime.arrival import TAUGHT, ArrivalWatch
from visctrl.runtime.config import to_yaml
from visctrl.runtime.consistency import NAME as CONSISTENCY
from visctrl.runtime.consistency import Consistency, gives_pose
from visctrl.runtime.ending import ended_by, settle
from visctrl.runtime.images import ImageRecorder
from visctrl.runtime.interrupts import Interrupts
from visctrl.runtime.loop import Loop, Tally
from visctrl.runtime.meter import Meter
from visctrl.runtime.pipeline import Stage, call_plugin
from visctrl.runtime.plan import Chosen, Plan, StagePlan
from visctrl.runtime.recorder import CONFIG, FAULT, Recorder, Reporting
from visctrl.runtime.records import Observer
from visctrl.runtime.run_directory import RunDirectory
from visctrl.runtime.safety import Guard, LostError
from visctrl.runtime.stop import StopRequest
from visctrl.runtime.summary import MISSED, End, Results, judge, summarise
from visctrl.schemes.arrival.check import Answer, Verdict
from visctrl.threads import one_thread_of_algebra

T = TypeVar("T")

#: Exit codes up to here are verdicts: reached, missed or lost.
_VERDICT = 1


@dataclass(frozen=True)
class Outcome:
    """What came of a run.

    summary : see `summarise`.
    directory : where its files lie, None if none were asked for.
    notes : what the user should know besides, a sentence each.
    """

    summary: dict[str, Any]
    exit_code: int
    directory: Path | None
    notes: tuple[str, ...]


def run_session(
    plan: Plan,
    out: Path | RunDirectory | None = None,
    *,
    observers: Sequence[Observer] = (),
    stop: StopRequest | None = None,
) -> Outcome:
    """Run a plan to its end, whatever that is.

    Parameters
    ----------
    plan : Plan
        What to run.
    out : Path, RunDirectory or None
        Where its files go: a directory that is not there yet or is empty, or one that is already
        claimed; None writes nothing.
    observers : sequence of Observer
        Told about everything that happens; pictures and pages are made by such
        (`visctrl.viewers`).
    stop : StopRequest or None
        Ends the run when it is made, from any thread.

    Raises
    ------
    InputError
        Something cannot be used, found before the robot was told anything. Nothing is left
        behind. Every other failure is an `Outcome`.
    """
    directory = RunDirectory(out) if isinstance(out, Path) else out
    shared = directory is not None and directory.shared
    with one_thread_of_algebra(), owner_only(unless=shared):
        return _Session(plan, directory, observers, stop or StopRequest()).run()


class _Session:
    def __init__(
        self,
        plan: Plan,
        directory: RunDirectory | None,
        observers: Sequence[Observer],
        stop: StopRequest,
    ) -> None:
        self._plan = plan
        self._stop_request = stop
        self._directory = directory
        self._meter = Meter()
        self._arrival = ArrivalWatch(plan)
        self._verdict: Verdict | None = None
        self._watchers = tuple(observers)
        self._observers: list[Observer] = [self._meter, self._arrival, *self._watchers]
        self._recorder: Recorder | None = None
        self._images: ImageRecorder | None = None
        if self._directory is not None and plan.scenario.record_images:
            self._images = ImageRecorder(self._directory.path, plan.camera)
            self._observers.append(self._images)
        self._interrupts = Interrupts()
        self._tally = Tally()
        self._plugins: list[Plugin[Any]] = []
        self._notes: list[str] = []
        self._unsaved = False
        self._truth: Pose | None = None
        self._began: tuple[float, float] | None = None
        self._took: tuple[float, float] | None = None

    def run(self) -> Outcome:
        with self._interrupts:
            try:
                with self._plan.open_backend() as backend:
                    end = self._conduct(backend)
            except InputError:
                if self._recorder is not None:
                    self._recorder.close()
                if self._images is not None:
                    self._images.close()
                for watcher in self._watchers:
                    watcher.close()
                if self._directory is not None:
                    self._directory.discard()
                raise
            except BaseException as error:
                end = ended_by(error)
            self._interrupts.ignore()
            return self._finish(end)

    # --- with the backend open ---------------------------------------------------------------

    def _conduct(self, backend: Backend) -> End:
        """Run every stage; return how it ended, with the robot told to stand still."""
        self._interrupts.suspendable = backend.clock.lockstep
        try:
            end = self._stages(backend)
        except BaseException as error:
            if isinstance(error, InputError) and self._tally.ticks == 0:
                raise
            end = ended_by(error)
        finally:
            self._interrupts.ignore()
            self._stop(backend)
        self._truth = backend.truth()
        if self._truth is not None:
            self._meter.move_to(self._truth)
        return end

    def _stages(self, backend: Backend) -> End:
        plan, scenario = self._plan, self._plan.scenario
        context = plan.context(backend.clock.lockstep)
        perception = self._build(plan.perception, context)
        stages = [
            self._stage("main", plan.main, context, scenario.duration_s),
        ]
        if plan.approach is not None:
            timeout = scenario.approach.timeout_s
            stages.insert(0, self._stage("approach", plan.approach, context, timeout))
        final = None
        if plan.final is not None:
            final = self._stage("final", plan.final, context, scenario.final.timeout_s)
        for stage in stages:
            for name, provider in stage.obstacles.items():
                expected = call_plugin(f"obstacle provider '{name}'", provider.expected)
                call_plugin(
                    f"controller '{stage.controller_name}'",
                    partial(stage.controller.expect, expected),
                )
        self._take_target(backend, perception)
        self._take_initial(backend, perception)
        everything = stages if final is None else [*stages, final]
        self._start_recording(everything, perception, backend.clock.lockstep)
        limiter = Limiter(plan.limits, whole_units=backend.base.whole_units)
        loop = Loop(
            backend,
            perception,
            plan.perception.name,
            Guard(limiter, scenario.safety, plan.period_s),
            plan.period_s,
            self._interrupts,
            self._observers,
            self._stop_request,
        )
        self._tally = loop.tally
        self._began = (backend.clock.now(), time.perf_counter())
        finished = False
        if final is not None and self._arrival.begins_near(perception, backend.camera.read()):
            finished = self._coincide(final, loop, backend)
            if not finished:
                self._take_initial_again(backend, perception, "after the last decimetre was tried")
        if not finished:
            for stage in stages:
                finished = self._run_stage(stage, loop, backend, perception)
                if stage.name == "approach" and not finished:
                    waited = f"after {stage.duration:g} s"
                    return End(MISSED, f"the robot did not face the target {waited}", 1)
            self._settle(backend)
            self._verdict = self._arrival.judge(backend)
            if final is not None and self._arrival.may_coincide(self._verdict):
                finished = self._coincide(final, loop, backend) or finished
        self._stop_watches(backend)
        assert self._verdict is not None
        return judge(plan, finished, self._verdict, backend.collisions())

    def _coincide(self, final: Stage, loop: Loop, backend: Backend) -> bool:
        """Bring the image to coincide; return whether it does."""
        final.estimator.reset()
        loop.run(final)
        self._settle(backend)
        self._verdict = self._arrival.judge(backend)
        return self._verdict.answer is Answer.THERE

    def _run_stage(
        self, stage: Stage, loop: Loop, backend: Backend, perception: Perception[Any]
    ) -> bool:
        """Run one stage; after a turn, take the initial view again from where the robot is."""
        call_plugin(f"estimator '{stage.estimator_name}'", stage.estimator.reset)
        loop.moved = False
        finished = loop.run(stage)
        if stage.name == "approach" and finished and loop.moved:
            self._settle(backend)
            self._take_initial_again(backend, perception, "after turning to the target")
        return finished

    def _take_initial_again(self, backend: Backend, perception: Perception[Any], when: str) -> None:
        try:
            self._take_initial(backend, perception)
        except InputError as error:
            raise LostError(f"{when}: {error}") from error

    def _stage(self, name: str, plan: StagePlan, context: Context, duration: float) -> Stage:
        return Stage(
            name,
            self._build(plan.estimator, context),
            self._build(plan.controller, context),
            plan.estimator.name,
            plan.controller.name,
            duration,
            {each.name: self._build(each, context) for each in plan.obstacles},
        )

    def _build(self, chosen: Chosen[T], context: Context) -> T:
        plugin = call_plugin(f"{chosen.kind} '{chosen.name}'", lambda: chosen.build(context))
        if isinstance(plugin, Plugin):
            self._plugins.append(plugin)
        return plugin

    def _start_recording(
        self, stages: Sequence[Stage], perception: Perception[Any], lockstep: bool
    ) -> None:
        for watcher in self._watchers:
            watcher.on_begin(lockstep=lockstep)
        if self._directory is None:
            return
        named: list[tuple[str, Reporting]] = [(self._plan.perception.name, perception)]
        for stage in stages:
            named.append((stage.estimator_name, stage.estimator))
            named.append((stage.controller_name, stage.controller))
            named.extend(stage.obstacles.items())
        if any(gives_pose(stage.estimator) for stage in stages):
            named.append((CONSISTENCY, Consistency()))
        if self._images is not None:
            self._images.may_wait = lockstep
        with writing(self._directory.path):
            self._directory.write_text(CONFIG, to_yaml(self._plan.effective()))
            self._recorder = Recorder(self._directory.path, named, lockstep=lockstep)
        self._observers.append(self._recorder)

    def _take_target(self, backend: Backend, perception: Perception[Any]) -> None:
        self._tell("taking the target view")
        view = self._plan.target
        count = self._plan.scenario.target.frames
        # Features of one frame are too noisy to judge arrival by.
        more = max(count, TAUGHT) if backend.delivers_features else count
        frames = backend.teach(more) if view is None else view.frames()
        if not frames:
            raise InputError(
                f"backend '{self._plan.scenario.backend}' cannot visit the target: take its view "
                "there with `visctrl teach -o target.npz`, and run with --target target.npz"
            )
        self._arrival.set_target(frames)
        if view is None:
            frames = frames[:count]
        call_plugin(self._perceiver, lambda: perception.set_target(frames))
        for observer in self._observers:
            observer.on_target(frames)

    def _take_initial(self, backend: Backend, perception: Perception[Any]) -> None:
        self._tell("matching the initial view to the target")
        frame = backend.camera.read()
        match = call_plugin(self._perceiver, lambda: perception.set_initial(frame), Match)
        for observer in self._observers:
            observer.on_initial(frame, match)

    @property
    def _perceiver(self) -> str:
        return f"perception '{self._plan.perception.name}'"

    def _tell(self, text: str) -> None:
        for observer in self._observers:
            observer.on_message(text)

    def _settle(self, backend: Backend) -> None:
        settle(backend, self._plan.period_s, self._plan.scenario.approach.settle_s)

    def _stop(self, backend: Backend) -> None:
        """Stop the base and the plugins; a failure is noted and stops nothing else."""
        self._stop_watches(backend)
        self._attempt("the base could not be stopped", backend.base.stop)
        for plugin in self._plugins:
            name = type(plugin).__name__
            self._attempt(
                f"{name} could not say what there is to know", partial(self._hear, plugin)
            )
            self._attempt(f"{name} could not be closed", plugin.close)

    def _stop_watches(self, backend: Backend) -> None:
        """Note how long it took; once."""
        if self._began is not None and self._took is None:
            clock_began, wall_began = self._began
            self._took = (backend.clock.now() - clock_began, time.perf_counter() - wall_began)

    def _hear(self, plugin: Plugin[Any]) -> None:
        self._notes += plugin.notes()

    def _attempt(self, failure: str, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:
            self._unsaved = self._unsaved or isinstance(error, OSError | DiskError)
            self._notes.append(f"{failure}: {error}")

    # --- with the backend closed -------------------------------------------------------------

    def _finish(self, end: End) -> Outcome:
        took = self._took or (0.0, 0.0)
        results = Results(self._meter, self._tally, self._verdict, self._truth, took)
        summary = summarise(self._plan, end, results)
        for kept in (self._recorder, self._images):
            if kept is not None:
                self._attempt("recording", kept.close)
                self._unsaved = self._unsaved or kept.failed
                if kept.problem and kept.problem != end.reason:
                    self._notes.append(kept.problem)
        if self._directory is not None:
            self._directory.release_reserve()
            self._write(self._directory, end, summary)
        for watcher in self._watchers:
            name = type(watcher).__name__
            self._attempt(f"{name} could not finish", partial(self._dismiss, watcher))
        if self._directory is not None:
            self._attempt("an earlier run could not be removed", self._directory.close)
        if self._tally.missed:
            blame = ", ".join(f"{name} {n}" for name, n in self._tally.blame.most_common())
            self._notes.append(f"{self._tally.missed} ticks missed, by cause: {blame}")
        directory = self._directory.path if self._directory is not None else None
        # A verdict whose record is lost is none.
        lost = self._unsaved and end.exit_code <= _VERDICT
        code = DiskError.exit_code if lost else end.exit_code
        return Outcome(summary, code, directory, tuple(self._notes))

    def _write(self, directory: RunDirectory, end: End, summary: dict[str, Any]) -> None:
        files = "a file could not be written"
        config = to_yaml(self._plan.effective())
        self._attempt(files, lambda: directory.write_text(CONFIG, config))
        self._attempt(files, lambda: directory.write_summary(summary))
        if end.details:
            self._attempt(files, lambda: directory.write_text(FAULT, end.details))

    def _dismiss(self, watcher: Observer) -> None:
        self._notes += watcher.on_end()
        watcher.close()
