"""A controller that kills its own process, for tests of what becomes of the study."""

from __future__ import annotations

import os
import signal
from typing import ClassVar

from visctrl.contracts import Controller, Decision, Estimate
from visctrl.hal.types import Velocity
from visctrl.robots.documents import StrictModel


class KillerOptions(StrictModel):
    """Which signal it sends, 0 for none."""

    number: int = 0


class Killer(Controller[KillerOptions, Estimate]):
    Options: ClassVar[type[KillerOptions]] = KillerOptions
    accepts: ClassVar[type[Estimate]] = Estimate

    def update(self, estimate: Estimate, sent: Velocity, dt: float) -> Decision:
        if self.options.number:
            os.kill(os.getpid(), signal.Signals(self.options.number))
        return Decision(finished=True)
