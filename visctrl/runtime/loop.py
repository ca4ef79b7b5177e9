"""The tick: frame, perception, estimation, control, safety, command."""

from __future__ import annotations

import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from visctrl.contracts import (
    Controller,
    Decision,
    Estimate,
    Estimator,
    Obstacle,
    ObstacleProvider,
    Perception,
    Plugin,
    Views,
)
from visctrl.hal.errors import BaseFaultError
from visctrl.hal.interfaces import Backend
from visctrl.hal.types import STANDSTILL, Frame, Odometry, Pose, Velocity
from visctrl.robots.errors import InputError, VisctrlError
from visctrl.runtime.consistency import NAME as CONSISTENCY
from visctrl.runtime.consistency import Consistency, gives_pose
from visctrl.runtime.interrupts import Interrupts
from visctrl.runtime.records import STAGES, Observer, TickRecord
from visctrl.runtime.safety import Guard, UnsafeCommandError
from visctrl.runtime.scheduler import Tick, Ticker, prompt_threads
from visctrl.runtime.stop import StopRequest
from visctrl.runtime.watchdog import Watchdog

#: Plugins with their names.
Reporting = tuple[tuple[str, Plugin[Any]], ...]


class PluginError(VisctrlError):
    """A plugin raised an exception in a tick.

    details : its traceback, for the file in the run directory.
    """

    exit_code = 3

    def __init__(self, who: str, error: Exception) -> None:
        super().__init__(f"{who} failed: {type(error).__name__}: {error}")
        self.details = "".join(traceback.format_exception(error))


@dataclass(frozen=True)
class Stage:
    """A part of a run with its own estimator and controller.

    duration : longest time it may take (s).
    obstacles : obstacle providers by name.
    """

    name: str
    estimator: Estimator[Any, Any]
    controller: Controller[Any, Any]
    estimator_name: str
    controller_name: str
    duration: float
    obstacles: Mapping[str, ObstacleProvider[Any, Any]] = field(default_factory=dict)


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
        if self._backend.clock.lockstep:
            return self._run(stage)
        self._watchdog = Watchdog(self._backend.base.stop, self._guard.max_command_age)
        at_once = self._stop.acting_at_once(self._watchdog.act)
        with self._watchdog, at_once, prompt_threads():
            return self._run(stage)

    def _run(self, stage: Stage) -> bool:
        self._consistency.prepare(stage.estimator)
        ticker = Ticker(self._backend.clock, self._period)
        self._guard.begin(ticker.origin)
        turn = _Turn(stage, self._reporting(stage))
        for observer in self._observers:
            observer.on_stage(stage.name)
        while True:
            tick = ticker.wait()
            if tick.start - ticker.origin > stage.duration:
                self._send(None)
                return False
            self._tick(turn, tick)
            if turn.decision.finished:
                return True

    def _send(self, velocity: Velocity | None) -> Velocity:
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
            self._watchdog.feed(moving=sent != STANDSTILL)
        self._guard.was_sent(sent, self._backend.clock.now())
        return sent

    def _tick(self, turn: _Turn, tick: Tick) -> None:
        """Do one tick of a stage."""
        self._stop.check()
        blame = self._count(tick, turn)
        turn.begin(self._timer())
        truth = self._backend.truth()
        odometry, battery_v = self._check_base()
        frame = self._backend.camera.read()
        turn.part(self._timer())
        views = self._views(frame)
        turn.part(self._timer())
        self._withdraw_old_command(turn)
        estimate = self._estimate(views, turn, tick)
        turn.part(self._timer())
        self._withdraw_old_command(turn)
        self._decide(estimate, turn, tick)
        turn.part(self._timer())
        self._command(frame, turn)
        turn.part(self._timer())
        record = TickRecord(
            number=self.tally.ticks,
            t=tick.start - self._origin,
            stage=turn.stage.name,
            tick=tick,
            frame=frame,
            views=views,
            estimate=estimate,
            decision=turn.decision,
            sent=turn.sent,
            odometry=odometry,
            truth=truth,
            battery_v=battery_v,
            event=turn.event,
            blame=blame,
            signals=self._signals(turn, estimate, truth),
            seconds=tuple(turn.seconds),
        )
        for observer in self._observers:
            observer.on_tick(record)
        turn.part(self._timer())
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
        return self._backend.base.odometry(), status.battery_v

    def _views(self, frame: Frame) -> Views:
        """Return what perception sees, or nothing where the frame is too old to be the present."""
        problem = self._guard.frame_problem(frame, self._backend.clock.now())
        if problem:
            return Views.nothing(frame.stamp, problem)
        try:
            return self._perception.update(frame)
        except Exception as error:
            raise PluginError(f"perception '{self._perception_name}'", error) from error

    def _estimate(self, views: Views, turn: _Turn, tick: Tick) -> Estimate:
        stage = turn.stage
        try:
            estimate = stage.estimator.update(views, turn.sent, tick.dt)
        except Exception as error:
            raise PluginError(f"estimator '{stage.estimator_name}'", error) from error
        if not isinstance(estimate, stage.controller.accepts):
            raise InputError(
                f"estimator '{stage.estimator_name}' gives {type(estimate).__name__}, controller "
                f"'{stage.controller_name}' needs {stage.controller.accepts.__name__}"
            )
        return estimate

    def _decide(self, estimate: Estimate, turn: _Turn, tick: Tick) -> None:
        """Ask the controller, whose time stands still while the robot is held."""
        now = self._backend.clock.now()
        if turn.steered and not turn.held:
            turn.acted_s += tick.dt
        turn.held = self._guard.must_hold(estimate.health, estimate.reason, now)
        turn.steered = True
        stage = turn.stage
        if turn.held:
            turn.event = turn.event or f"held: {estimate.reason or 'features lost'}"
            turn.decision = Decision(STANDSTILL, turn.decision.phase)
            return
        if stage.obstacles:
            stage.controller.sense(self._obstacles(stage, estimate, now))
        try:
            turn.decision = stage.controller.update(estimate, turn.steering, turn.acted_s)
        except Exception as error:
            raise PluginError(f"controller '{stage.controller_name}'", error) from error
        turn.steering, turn.acted_s = STANDSTILL, 0.0

    def _obstacles(self, stage: Stage, estimate: Estimate, now: float) -> list[Obstacle]:
        """Ask the obstacle providers."""
        found: list[Obstacle] = []
        for name, provider in stage.obstacles.items():
            ranges = self._backend.base.ranges() if provider.listens else ()
            try:
                found += provider.update(estimate, ranges, now)
            except Exception as error:
                raise PluginError(f"obstacle provider '{name}'", error) from error
        return found

    def _command(self, frame: Frame, turn: _Turn) -> None:
        now = self._backend.clock.now()
        wanted = turn.decision.velocity
        if self._guard.too_old(frame, now) and not turn.held:
            turn.held = True
            turn.event = turn.event or "held: the frame grew old while it was worked on"
        turn.sent = self._send(self._permitted(wanted, turn, now))
        if not turn.held:
            turn.steering = turn.sent
        self.moved = self.moved or turn.sent != STANDSTILL

    def _permitted(self, wanted: Velocity, turn: _Turn, now: float) -> Velocity | None:
        """Return what may be sent, None where the robot must stop."""
        if turn.held or turn.decision.finished:
            return None
        try:
            return self._guard.permit(wanted, now)
        except UnsafeCommandError as error:
            name = turn.stage.controller_name
            raise UnsafeCommandError(f"controller '{name}': {error}") from None

    def _withdraw_old_command(self, turn: _Turn) -> None:
        """Stop a robot whose last command has grown old while a plugin was at work."""
        if self._guard.expired(self._backend.clock.now()):
            turn.sent = turn.steering = self._send(None)
            turn.event = "stopped: the command in force was too old"

    def _signals(
        self, turn: _Turn, estimate: Estimate, truth: Pose | None
    ) -> tuple[tuple[str, Mapping[str, float]], ...]:
        """Return what the plugins report of this tick, as far as anybody reads it."""
        found = [(name, dict(plugin.values())) for name, plugin in turn.reporting]
        reported = dict(found).get(turn.stage.estimator_name, {})
        if judged := self._consistency.values(estimate, truth, reported):
            found.append((CONSISTENCY, judged))
        return tuple(found)

    def _reporting(self, stage: Stage) -> Reporting:
        """Return the plugins of a stage whose signals somebody reads, with their names."""
        everybody: Reporting = (
            (self._perception_name, self._perception),
            (stage.estimator_name, stage.estimator),
            (stage.controller_name, stage.controller),
            *stage.obstacles.items(),
        )
        read = everybody if any(observer.reads_signals for observer in self._observers) else ()
        if not read and gives_pose(stage.estimator):
            # Its consistency is always judged, by what it says of itself too.
            read = everybody[1:2]
        return tuple((name, plugin) for name, plugin in read if plugin.signals)


class _Turn:
    """What one stage remembers from tick to tick.

    reporting : the plugins whose signals are read.
    sent : velocity that the base was last told.
    held : the robot is kept at a standstill for want of features.
    steering : what was sent for the controller's last decision; acted_s : for how long (s).
    event : what safety did in this tick.
    seconds : duration of the tick's parts so far.
    """

    def __init__(self, stage: Stage, reporting: Reporting) -> None:
        self.stage = stage
        self.reporting = reporting
        self.sent: Velocity = STANDSTILL
        self.decision = Decision()
        self.held = False
        self.steered = False
        self.steering: Velocity = STANDSTILL
        self.acted_s = 0.0
        self.event = ""
        self.seconds: list[float] = []
        self._mark = 0.0

    def begin(self, now: float) -> None:
        """Start a tick."""
        self.event = ""
        self.seconds = []
        self._mark = now

    def part(self, now: float) -> None:
        """End a part of the tick."""
        self.seconds.append(now - self._mark)
        self._mark = now

    def slowest(self) -> str:
        """Return the part of the tick that took longest."""
        return STAGES[max(range(len(self.seconds)), key=self.seconds.__getitem__)]
