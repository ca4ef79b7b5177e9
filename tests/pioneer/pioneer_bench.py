"""An emulated robot at the end of a pseudo-terminal or a TCP port, and a driver for it."""

from __future__ import annotations

import time
from dataclasses import dataclass

from hal.clock import WallClock
from hal.errors import BaseFaultError
from hal.pioneer.base import PioneerBase
from hal.pioneer.emulator.emulator import Emulator
from hal.pioneer.emulator.ports import Port, PtyPort, TcpPort
from hal.types import Velocity
from robots import load_robot

PERIOD_S = 0.1


def make_port(kind: str) -> Port:
    return PtyPort() if kind == "pty" else TcpPort()


@dataclass
class Bench:
    """An emulator and what a test does with it."""

    emulator: Emulator

    def base(self, robot: str = "p3dx") -> PioneerBase:
        limits = load_robot(robot).operating
        return PioneerBase(self.emulator.url, robot, limits, WallClock())

    def drive(self, base: PioneerBase, velocity: Velocity, seconds: float) -> Velocity:
        """Command at 10 Hz, as a scheduler that stops for every fault does."""
        deadline = time.monotonic() + seconds
        sent = Velocity(0.0, 0.0)
        while time.monotonic() < deadline:
            sent = base.command(velocity)
            if faults := base.status().faults:
                base.stop()
                raise BaseFaultError("; ".join(faults))
            time.sleep(PERIOD_S)
        return sent

    def get_up_to(self, base: PioneerBase, velocity: Velocity, limit: float = 10.0) -> None:
        """Drive until the robot has the commanded speed."""
        deadline = time.monotonic() + limit
        while abs(self.emulator.velocity.v - velocity.v) > 1e-9:
            assert time.monotonic() < deadline, f"still at {self.emulator.velocity}"
            self.drive(base, velocity, PERIOD_S)

    def standstill_after(self, limit: float) -> float:
        """Return after how long (s) the robot stands, at most ``limit``."""
        start = time.monotonic()
        while time.monotonic() - start < limit:
            if self.emulator.velocity == (0.0, 0.0):
                return time.monotonic() - start
            time.sleep(0.005)
        raise AssertionError(f"still at {self.emulator.velocity} after {limit} s")

    def next_run_works(self, *, legal: bool = True) -> None:
        """Another driver connects at once and drives; all that was ever sent was legal."""
        base = self.base()
        base.open()
        try:
            self.drive(base, Velocity(0.2, 0.0), 0.5)
            assert self.emulator.velocity.v > 0.05
        finally:
            base.close()
        assert self.emulator.velocity == (0.0, 0.0)
        assert not self.emulator.motors
        if legal:  # the line has not spoilt what was sent
            assert self.emulator.traffic.violations() == []
