"""An emulated robot on simulated time, a driver for it, and what tests do with both."""

from __future__ import annotations

from dataclasses import dataclass

from virtual_robot import Site

from visctrl.hal.clock import WallClock
from visctrl.hal.emulator.emulator import Emulator
from visctrl.hal.errors import BaseFaultError
from visctrl.hal.pioneer.base import PioneerBase
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.robots import load_robot

PERIOD_S = 0.1


@dataclass
class Bench:
    """A robot and its site."""

    site: Site
    robot: Emulator

    def base(self, robot: str = "p3dx", **options: float) -> PioneerBase:
        its = load_robot(robot)
        return PioneerBase(self.robot.url, its, its.operating, WallClock(), **options)  # type: ignore[arg-type]

    def drive(self, base: PioneerBase, velocity: Velocity, seconds: float) -> Velocity:
        """Command at 10 Hz, as a scheduler that stops for every fault does."""
        deadline = self.site.world.now + seconds
        sent = STANDSTILL
        while self.site.world.now < deadline:
            sent = base.command(velocity)
            if faults := base.status().faults:
                base.stop()
                raise BaseFaultError("; ".join(faults))
            self.site.world.sleep(PERIOD_S)
        return sent

    def get_up_to(self, base: PioneerBase, velocity: Velocity, limit: float = 10.0) -> None:
        """Drive until the robot has the commanded speed."""
        deadline = self.site.world.now + limit
        while abs(self.robot.velocity.v - velocity.v) > 1e-9:
            assert self.site.world.now < deadline, f"still at {self.robot.velocity}"
            self.drive(base, velocity, PERIOD_S)

    def standstill_after(self, limit: float) -> float:
        """Return after how long (s) the robot stands, at most ``limit``."""
        return self.site.wait_until(lambda: self.robot.velocity == STANDSTILL, limit)

    def next_run_works(self, *, legal: bool = True) -> None:
        """Another driver connects at once and drives; all that was ever sent was legal."""
        base = self.base()
        base.open()
        try:
            self.drive(base, Velocity(0.2, 0.0), 0.5)
            assert self.robot.velocity.v > 0.05
        finally:
            base.close()
        assert self.robot.velocity == STANDSTILL
        assert not self.robot.motors
        if legal:  # the line has not spoilt what was sent
            assert self.robot.traffic.violations() == []
