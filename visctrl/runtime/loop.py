"""The loop: frame, pipeline of plugins, safety, command, at the scheduler's ticks."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from visctrl.contracts import Estimate, Perception, Views
from visctrl.hal.errors import BaseFaultError, StaleFrameError
from visctrl.hal.interfaces import Backend
from visctrl.hal.types import STANDSTILL, Frame, Odometry, Pose, Range, Velocity
from visctrl.runtime.boundaries import check_odometry, check_sent
from visctrl.runtime.consistency import NAME as CONSISTENCY
from visctrl.runtime.consistency import Consistency, gives_pose
from visctrl.runtime.image_motion import ImageMotion
from visctrl.runtime.interrupts import Interrupts
from visctrl.runtime.overdue import CallLimit
from visctrl.runtime.pipeline import Pipeline, Reporting, Stage, Watch, signals_of
from visctrl.runtime.records import STAGES, Observer, TickRecord
from visctrl.runtime.safety import Guard, UnsafeCommandError
from visctrl.runtime.scheduler import Tick, Ticker, prompt_threads
from visctrl.runtime.stop import StopRequest
from visctrl.runtime.watchdog import Watchdog


@dataclass
class Tally:
    """What is counted over all stages of a run.

    blame : missed deadlines by the part of the tick that took the time.
    """

    ticks: int = 0
    missed: int = 0
    blame: Counter[str] = field(default_factory=Counter)


class Loop:
    """Runs stages on an open backend.

    Parameters
    ----------
    backend : Backend
        Open.
    perception : Perception
        Target and initial views set.
    perception_name : str
        For messages.
    guard : Guard
        Judges frames, estimates and commands.
    period : float
        Nominal tick (s).
    interrupts : Interrupts
        Shielded while a command is on its way.
    observers : sequence of Observer
        Told about every tick.
    stop : StopRequest
        Ends the run when it is made.
    """

    def __init__(
        self,
        backend: Backend,
        perception: Perception[Any],
        perception_name: str,
        guard: Guard,
        period: float,
        interrupts: Interrupts,
        observers: Sequence[Observer],
        stop: StopRequest,
    ) -> None:
        self._backend = backend
        self._stop = stop
        self._perception = perception
        self._perception_name = perception_name
        self._guard = guard
        self._period = period
        self._interrupts = interrupts
        self._observers = observers
        # Where time stands still during a tick, the parts are timed by the processor's clock.
        clock = backend.clock
        self._timer: Callable[[], float] = time.perf_counter if clock.lockstep else clock.now
        self._origin = clock.now()
        self._consistency = Consistency()
        # Not started: where time stands still, no command grows old.
        self._watchdog = Watchdog(backend.base.stop, guard.max_command_age)
        self.tally = Tally()
        #: Whether the robot has been told to move; may be reset between stages.
        self.moved = False

    def run(self, stage: Stage) -> bool:
        """Tick until the controller has finished or the time is over; return which it was.

        The robot must stand still; afterwards it has been told to.

        Raises
        ------
        DeviceError, PluginError, LostError, UnsafeCommandError
            The run cannot go on.
        StopRequested
            Somebody wants it to end.
        """
        lockstep = self._backend.clock.lockstep
        with CallLimit(stage.duration, lockstep, self._interrupts) as limit:
            return self._run(stage, limit) if lockstep else self._run_watched(stage, limit)

    def _run_watched(self, stage: Stage, limit: CallLimit) -> bool:
        self._watchdog = Watchdog(self._backend.base.stop, self._guard.max_command_age)
        at_once = self._stop.acting_at_once(self._watchdog.act)
        with self._watchdog, at_once, prompt_threads():
            return self._run(stage, limit)

    def _run(self, stage: Stage, limit: CallLimit) -> bool:
        self._consistency.prepare(stage.estimator)
        ticker = Ticker(self._backend.clock, self._period)
        self._guard.begin(ticker.origin)
        turn = _Turn(self, self._guard, self._backend, self._timer, limit)
        pipeline = turn.pipeline = Pipeline(self._perception, self._perception_name, stage, turn)
        reporting = self._read(pipeline.reporting(), stage)
        for observer in self._observers:
            observer.on_stage(stage.name)
        while True:
            tick = ticker.wait()
            if tick.start - ticker.origin > stage.duration:
                self.send(None)
                return False
            self._tick(pipeline, turn, tick, reporting)
            if pipeline.decision.finished:
                return True

    def send(self, velocity: Velocity | None) -> Velocity:
        """Send a command, or stop for None, undisturbed by signals and by the watchdog.

        Return what was really sent.
        """
        base = self._backend.base
        with self._interrupts.shield, self._watchdog.lock:
            if velocity is None:
                base.stop()
                sent = STANDSTILL
            else:
                self._stop.check()
                sent = base.command(velocity)
                check_sent(sent)
            self._watchdog.feed(moving=sent != STANDSTILL)
        self._guard.was_sent(sent, self._backend.clock.now())
        return sent

    def _tick(self, pipeline: Pipeline, turn: _Turn, tick: Tick, reporting: Reporting) -> None:
        """Do one tick of a stage."""
        self._stop.check()
        blame = self._count(tick, turn)
        turn.begin()
        truth = self._backend.truth()
        odometry, battery_v = self._check_base()
        turn.odometry = odometry
        frame = self._backend.camera.read()
        turn.mark()
        problem = self._guard.frame_problem(frame, self._backend.clock.now())
        views, estimate = pipeline.tick(frame, problem, tick.dt)
        self._command(frame, pipeline)
        turn.mark()
        record = TickRecord(
            number=self.tally.ticks,
            t=tick.start - self._origin,
            stage=pipeline.stage.name,
            tick=tick,
            frame=frame,
            views=views,
            estimate=estimate,
            decision=pipeline.decision,
            sent=pipeline.sent,
            odometry=odometry,
            truth=truth,
            battery_v=battery_v,
            event=pipeline.event,
            blame=blame,
            signals=self._signals(reporting, pipeline.stage, estimate, truth),
            seconds=tuple(turn.seconds),
        )
        for observer in self._observers:
            observer.on_tick(record)
        turn.mark()
        self.tally.ticks += 1

    def _count(self, tick: Tick, turn: _Turn) -> str:
        """Count missed deadlines; return what made the robot miss them."""
        if tick.missed == 0:
            return ""
        blame = turn.slowest() if tick.skipped else "system"
        self.tally.missed += tick.missed
        self.tally.blame[blame] += tick.missed
        return blame

    def _check_base(self) -> tuple[Odometry, float | None]:
        status = self._backend.base.status()
        if status.faults:
            raise BaseFaultError("; ".join(status.faults))
        odometry = self._backend.base.odometry()
        check_odometry(odometry)
        return odometry, status.battery_v

    def _command(self, frame: Frame, pipeline: Pipeline) -> None:
        now = self._backend.clock.now()
        if self._guard.too_old(frame, now) and not pipeline.held:
            pipeline.hold("the frame grew old while it was worked on")
        pipeline.was_sent(self.send(self._permitted(pipeline, now)))
        self.moved = self.moved or pipeline.sent != STANDSTILL

    def _permitted(self, pipeline: Pipeline, now: float) -> Velocity | None:
        """Return what may be sent, None where the robot must stop."""
        if pipeline.held or pipeline.decision.finished:
            return None
        try:
            return self._guard.permit(pipeline.decision.velocity, now)
        except UnsafeCommandError as error:
            name = pipeline.stage.controller_name
            raise UnsafeCommandError(f"controller '{name}': {error}") from None

    def _signals(
        self, reporting: Reporting, stage: Stage, estimate: Estimate, truth: Pose | None
    ) -> tuple[tuple[str, Mapping[str, float]], ...]:
        """Return what the plugins report of this tick, as far as anybody reads it."""
        found = signals_of(reporting)
        reported = dict(found).get(stage.estimator_name, {})
        if judged := self._consistency.values(estimate, truth, reported):
            found.append((CONSISTENCY, judged))
        return tuple(found)

    def _read(self, reporting: Reporting, stage: Stage) -> Reporting:
        """Return the plugins whose signals somebody reads."""
        if any(observer.reads_signals for observer in self._observers):
            return reporting
        if gives_pose(stage.estimator):
            # Its consistency is always judged, by what it says of itself too.
            return tuple(each for each in reporting if each[1] is stage.estimator)
        return ()


class _Turn(Watch):
    """Times the parts of a stage's ticks, and looks after the robot between them.

    seconds : duration of the tick's parts so far.
    """

    pipeline: Pipeline
    odometry: Odometry

    def __init__(
        self,
        loop: Loop,
        guard: Guard,
        backend: Backend,
        timer: Callable[[], float],
        limit: CallLimit,
    ) -> None:
        self._loop, self._guard, self._backend = loop, guard, backend
        self._timer, self._limit = timer, limit
        self._motion = ImageMotion(backend.camera.model.height)
        self.seconds: list[float] = []
        self._mark = 0.0

    def begin(self) -> None:
        """Start a tick."""
        self.seconds = []
        self._mark = self._timer()

    def mark(self) -> None:
        """End a part of the tick."""
        now = self._timer()
        self.seconds.append(now - self._mark)
        self._mark = now

    def slowest(self) -> str:
        """Return the part of the tick that took longest."""
        return STAGES[max(range(len(self.seconds)), key=self.seconds.__getitem__)]

    def calling(self, who: str) -> None:
        """See `CallLimit.calling`."""
        self._limit.calling(who)

    def after(self, part: str) -> None:
        """Stop a robot whose last command has grown old while a plugin was at work."""
        self._limit.calling("")
        self.mark()
        if part != "control" and self._guard.expired(self.now()):
            self._loop.send(None)
            self.pipeline.was_stopped("stopped: the command in force was too old")

    def check_motion(self, views: Views) -> None:
        """Raise StaleFrameError for views that stand still while the robot moves."""
        if problem := self._motion.judge(views, self.odometry):
            raise StaleFrameError(problem)

    def must_hold(self, estimate: Estimate) -> bool:
        """See `Guard.must_hold`."""
        return self._guard.must_hold(estimate.health, estimate.reason, self.now())

    def now(self) -> float:
        """Return the time on the backend's clock (s)."""
        return self._backend.clock.now()

    def ranges(self) -> Sequence[Range]:
        """See `Base.ranges`."""
        return self._backend.base.ranges()
