"""Plugins that do little and fail on demand, for tests of what runs them."""

from __future__ import annotations

import math
import os
import signal
import time
from dataclasses import dataclass
from typing import ClassVar, Literal

from hal.types import Velocity
from robots.documents import Document
from visctrl.plugins import Controller, Decision, Estimate, Estimator, Health, Signal, Views

FAR = math.inf


class NoOptions(Document):
    pass


@dataclass(frozen=True)
class ToyEstimate(Estimate):
    features: int = 0


class ToyEstimator(Estimator[NoOptions, ToyEstimate]):
    """Counts features and remembers what it was told."""

    Options: ClassVar[type[NoOptions]] = NoOptions
    signals = (Signal("distance", "m"),)

    def reset(self) -> None:
        self.distance = 0.0

    def update(self, views: Views, sent: Velocity, dt: float) -> ToyEstimate:
        self.distance += sent.v * dt
        return ToyEstimate(views.health, views.reason, len(views))

    def values(self) -> dict[str, float]:
        return {"distance": self.distance}


class ToyOptions(Document):
    """Drive with (v, omega) for ``drive_s``, then finish; do ``trouble`` at ``at_s``."""

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

    left = 0.0
    done = False

    def update(self, estimate: ToyEstimate, t: float) -> Decision:
        assert estimate.health is not Health.LOST
        self.left = self.options.drive_s - t
        if self.options.at_s is not None and t > self.options.at_s - 1e-9 and not self.done:
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
