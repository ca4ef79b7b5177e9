"""Plugins and a backend that do little and fail on demand, for tests of what runs them."""

from __future__ import annotations

import math
import os
import signal
import time
from dataclasses import dataclass
from typing import ClassVar, Literal

from visctrl.contracts import Controller, Decision, Estimate, Estimator, Health, Signal, Views
from visctrl.hal.errors import CameraError
from visctrl.hal.interfaces import BackendSetup
from visctrl.hal.mock.backend import MockBackend, MockOptions
from visctrl.hal.types import BaseStatus, Frame, Velocity
from visctrl.robots.documents import StrictModel


class SpyOptions(MockOptions):
    """Faults that the mock itself does not have."""

    camera_dies_s: float | None = None
    base_fault_s: float | None = None
    stop_fails: bool = False


class SpyBackend(MockBackend):
    """A mock that notes what is sent to its base and whether it was closed."""

    Options = SpyOptions
    opened: ClassVar[list[SpyBackend]] = []

    def __init__(self, setup: BackendSetup[SpyOptions]) -> None:
        super().__init__(setup)
        self.spy_options = setup.options
        self.commands: list[tuple[float, Velocity]] = []
        self.closed = 0

    def open(self) -> None:
        super().open()
        self.opened.append(self)
        self._watch_commands()
        self._watch_camera()
        self.base.status = self._status  # type: ignore[method-assign]

    def close(self) -> None:
        super().close()
        self.closed += 1

    def _watch_commands(self) -> None:
        command = self.base.command

        def noted(velocity: Velocity) -> Velocity:
            sent = command(velocity)
            self.commands.append((self.clock.now(), sent))
            return sent

        self.base.command = noted  # type: ignore[method-assign]

    def _watch_camera(self) -> None:
        read = self.camera.read
        dies = self.spy_options.camera_dies_s

        def failing() -> Frame:
            if dies is not None and self.clock.now() >= dies:
                raise CameraError("the camera is gone")
            return read()

        self.camera.read = failing  # type: ignore[method-assign]

    def _status(self) -> BaseStatus:
        at = self.spy_options.base_fault_s
        broken = at is not None and self.clock.now() >= at
        return BaseStatus(12.5, ("left wheel stalled",) if broken else ())


class NoOptions(StrictModel):
    pass


@dataclass(frozen=True)
class ToyEstimate(Estimate):
    features: int = 0


class ToyEstimator(Estimator[NoOptions, ToyEstimate]):
    """Counts features and remembers what it was told."""

    Options: ClassVar[type[NoOptions]] = NoOptions
    signals = (Signal("distance", "m"),)
    distance = 0.0

    def reset(self) -> None:
        self.distance = 0.0
        self.steps: list[float] = []

    def update(self, views: Views, sent: Velocity, dt: float) -> ToyEstimate:
        self.distance += sent.v * dt
        self.steps.append(dt)
        return ToyEstimate(views.health, views.reason, len(views))

    def values(self) -> dict[str, float]:
        return {"distance": self.distance}


class ToyOptions(StrictModel):
    """Drive with (v, omega) for ``drive_s``, then finish; make ``trouble`` at ``at_s``."""

    v: float = 0.2
    omega: float = 0.0
    drive_s: float = 5.0
    finish: bool = True
    at_s: float | None = None
    trouble: Literal["raise", "nan", "interrupt", "sigterm", "sigint", "stall"] = "raise"
    stall_s: float = 0.25


class ToyController(Controller[ToyOptions, ToyEstimate]):
    Options: ClassVar[type[ToyOptions]] = ToyOptions
    accepts = ToyEstimate
    signals = (Signal("left", "s"),)
    #: Set by tests that run on a clock of their own.
    sleep = staticmethod(time.sleep)

    t = left = 0.0
    done = False

    def update(self, estimate: ToyEstimate, sent: Velocity, dt: float) -> Decision:
        assert estimate.health is not Health.LOST
        self.t += dt
        self.left = self.options.drive_s - self.t
        if self.options.at_s is not None and self.t > self.options.at_s - 1e-9 and not self.done:
            self.done = True
            if (decision := self._trouble()) is not None:
                return decision
        if self.left > 1e-9:
            return Decision(Velocity(self.options.v, self.options.omega), "drive")
        return Decision(phase="done", finished=self.options.finish)

    def values(self) -> dict[str, float]:
        return {"left": self.left}

    def _trouble(self) -> Decision | None:
        match self.options.trouble:
            case "raise":
                raise ZeroDivisionError("toy trouble")
            case "interrupt":
                raise KeyboardInterrupt
            case "nan":
                return Decision(Velocity(math.nan, 0.0), "drive")
            case "stall":
                self.sleep(self.options.stall_s)
            case "sigterm":
                os.kill(os.getpid(), signal.SIGTERM)
            case "sigint":
                os.kill(os.getpid(), signal.SIGINT)
        return None


class ToyApproachOptions(StrictModel):
    turn_s: float = 1.0


class ToyApproach(Controller[ToyApproachOptions, ToyEstimate]):
    """Turns for a while; for no time at all, it finishes at once."""

    Options: ClassVar[type[ToyApproachOptions]] = ToyApproachOptions
    accepts = ToyEstimate

    t = 0.0

    def update(self, estimate: ToyEstimate, sent: Velocity, dt: float) -> Decision:
        self.t += dt
        if self.t < self.options.turn_s - 1e-9:
            return Decision(Velocity(0.0, 0.2), "turn")
        return Decision(phase="faced", finished=True)
