"""One tick of the plugins: perception, estimation, control. Run and replay tick with it alike."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from visctrl.contracts import (
    Controller,
    Decision,
    Estimate,
    Estimator,
    Health,
    Obstacle,
    ObstacleProvider,
    Perception,
    Plugin,
    Views,
)
from visctrl.hal.types import STANDSTILL, Frame, Range, Velocity
from visctrl.robots.errors import InputError, VisctrlError
from visctrl.runtime.boundaries import (
    Checkpoint,
    lost,
    sound_estimate,
    sound_frame,
    sound_ranges,
    sound_views,
    unsound_obstacle,
)

T = TypeVar("T")

#: Plugins with their names.
Reporting = tuple[tuple[str, Plugin[Any]], ...]


class PluginError(VisctrlError):
    """A plugin raised an exception.

    details : its traceback, for the file in the run directory.
    """

    exit_code = 3

    def __init__(self, who: str, error: Exception) -> None:
        super().__init__(f"{who} failed: {type(error).__name__}: {error}")
        self.details = "".join(traceback.format_exception(error))


def call_plugin(who: str, work: Callable[[], T], gives: type[T] | None = None) -> T:
    """Call into a plugin outside a tick; what it raises for the user passes, the rest is a fault.

    Raises
    ------
    PluginError
        It raised anything but a `VisctrlError`, or returned something else than ``gives``.
    """
    try:
        found = work()
        if gives is not None and not isinstance(found, gives):
            raise TypeError(f"returned {type(found).__name__}, not {gives.__name__}")
    except VisctrlError:
        raise
    except Exception as error:
        raise PluginError(who, error) from error
    return found


def signals_of(reporting: Reporting) -> list[tuple[str, Mapping[str, float]]]:
    """Return this tick's numbers of plugins, by their names.

    Raises
    ------
    PluginError
        One could not give them.
    """
    found: list[tuple[str, Mapping[str, float]]] = []
    for name, plugin in reporting:
        try:
            found.append((name, dict(plugin.values())))
        except Exception as error:
            raise PluginError(f"plugin '{name}', asked for its signals,", error) from error
    return found


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


class Watch:
    """What happens between the parts of a tick; the default is what a recording needs."""

    def calling(self, who: str) -> None:
        """Hear that a plugin is called."""

    def after(self, part: str) -> None:
        """Hear that a part of the tick is over (see `records.STAGES`)."""

    def check_motion(self, views: Views) -> None:
        """Raise StaleFrameError for views that cannot be of the present (see `ImageMotion`)."""

    def must_hold(self, estimate: Estimate) -> bool:
        """Return whether the robot must stand still for want of features."""
        return estimate.health is Health.LOST

    def now(self) -> float:
        """Return the time (s)."""
        return 0.0

    def ranges(self) -> Sequence[Range]:
        """Return what the range sensors say now."""
        return ()


class Pipeline:
    """Asks the plugins of one stage in their order, once a tick, and remembers what was sent.

    Parameters
    ----------
    perception : Perception
        Target and initial views set.
    perception_name : str
        For messages.
    stage : Stage
        Its estimator is reset.
    watch : Watch
        Told between the parts.

    Attributes
    ----------
    sent : Velocity
        What the base was last told.
    decision : Decision
        The controller's newest; a standstill in its last phase while the robot is held.
    held : bool
        Whether the robot is kept at a standstill.
    event : str
        What safety did in this tick, empty if nothing.
    """

    def __init__(
        self, perception: Perception[Any], perception_name: str, stage: Stage, watch: Watch
    ) -> None:
        self.stage = stage
        self._perception = perception
        self._perception_name = perception_name
        self._watch = watch
        self.sent: Velocity = STANDSTILL
        self.decision = Decision()
        self.held = False
        self.event = ""
        # What was sent for the controller's last decision, and for how long it has acted (s).
        self._steering: Velocity = STANDSTILL
        self._acted_s = 0.0
        self._steered = False
        self._checkpoint = Checkpoint(stage.estimator)

    def tick(self, frame: Frame, problem: str, dt: float) -> tuple[Views, Estimate]:
        """Do one tick; the decision is kept.

        problem : why the frame must not be used, empty if it may be.
        dt : time since the last tick (s).

        Raises
        ------
        PluginError
            A plugin raised an exception.
        InputError
            The estimate is not what the controller takes.
        """
        self.event = ""
        views, refused = self._see(frame, problem)
        self._watch.after("perception")
        estimate = self._locate(views, refused, dt)
        self._watch.after("estimation")
        self._decide(estimate, dt)
        self._watch.after("control")
        return views, estimate

    def hold(self, reason: str) -> None:
        """Keep the robot at a standstill in this tick."""
        self.held = True
        self.event = self.event or f"held: {reason}"

    def was_sent(self, sent: Velocity) -> None:
        """Note what the base was told in this tick."""
        self.sent = sent
        if not self.held:
            self._steering = sent

    def was_stopped(self, event: str) -> None:
        """Note that the base was told to stop while the plugins were at work."""
        self.sent = self._steering = STANDSTILL
        self.event = event

    def reporting(self) -> Reporting:
        """Return the plugins that report numbers, with their names."""
        stage = self.stage
        everybody: Reporting = (
            (self._perception_name, self._perception),
            (stage.estimator_name, stage.estimator),
            (stage.controller_name, stage.controller),
            *stage.obstacles.items(),
        )
        return tuple((name, plugin) for name, plugin in everybody if plugin.signals)

    def _see(self, frame: Frame, problem: str) -> tuple[Views, str]:
        """Return the views, and why the frame or they were refused."""
        if problem:
            return Views.nothing(frame.stamp, problem), problem
        who = f"perception '{self._perception_name}'"
        self._watch.calling(who)
        try:
            views = self._perception.update(sound_frame(frame))
        except Exception as error:
            raise PluginError(who, error) from error
        _check_type(who, views, Views)
        views, refused = sound_views(views)
        self._watch.check_motion(views)
        return views, refused

    def _locate(self, views: Views, refused: str, dt: float) -> Estimate:
        """Return the estimate; no estimator may guess its way past what had to be refused."""
        stage, who = self.stage, f"estimator '{self.stage.estimator_name}'"
        sent = self.sent
        self._watch.calling(who)
        try:
            estimate = stage.estimator.update(views, sent, dt)
        except Exception as error:
            raise PluginError(who, error) from error
        _check_type(who, estimate, Estimate)
        estimate, sound = sound_estimate(estimate)
        try:
            if sound:
                self._checkpoint.passed(views, sent, dt)
            else:
                self._checkpoint.go_back(estimate.reason, views.stamp, sent, dt)
        except Exception as error:
            raise PluginError(who, error) from error
        if refused:
            estimate = lost(estimate, refused)
        if not isinstance(estimate, stage.controller.accepts):
            raise InputError(
                f"estimator '{stage.estimator_name}' gives {type(estimate).__name__}, controller "
                f"'{stage.controller_name}' needs {stage.controller.accepts.__name__}"
            )
        return estimate

    def _decide(self, estimate: Estimate, dt: float) -> None:
        """Ask the controller, whose time stands still while the robot is held."""
        if self._steered and not self.held:
            self._acted_s += dt
        self.held = self._watch.must_hold(estimate)
        self._steered = True
        if self.held:
            self.hold(estimate.reason or "features lost")
            self.decision = Decision(STANDSTILL, self.decision.phase)
            return
        stage, who = self.stage, f"controller '{self.stage.controller_name}'"
        try:
            obstacles = self._obstacles(estimate)
            self._watch.calling(who)
            if stage.obstacles:
                stage.controller.sense(obstacles)
            decision = stage.controller.update(estimate, self._steering, self._acted_s)
        except PluginError:
            raise
        except Exception as error:
            raise PluginError(who, error) from error
        _check_type(who, decision, Decision)
        self.decision = decision
        self._steering, self._acted_s = STANDSTILL, 0.0

    def _obstacles(self, estimate: Estimate) -> list[Obstacle]:
        """Ask the obstacle providers."""
        found: list[Obstacle] = []
        now = self._watch.now()
        for name, provider in self.stage.obstacles.items():
            ranges = sound_ranges(self._watch.ranges()) if provider.listens else ()
            self._watch.calling(f"obstacle provider '{name}'")
            try:
                obstacles = provider.update(estimate, ranges, now)
                if problem := unsound_obstacle(obstacles):
                    raise ValueError(problem)
            except Exception as error:
                raise PluginError(f"obstacle provider '{name}'", error) from error
            found += obstacles
        return found


def _check_type(who: str, given: object, wanted: type) -> None:
    """Raise PluginError where a plugin has given something else than its contract says."""
    if not isinstance(given, wanted):
        article = "an" if wanted is Estimate else "a"
        what = f"gave {type(given).__name__}, not {article} {wanted.__name__}"
        raise PluginError(who, TypeError(what))
