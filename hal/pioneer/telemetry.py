"""What the robot's reports add up to: odometry, health, sonar. No I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass

from visctrl.hal.pioneer.config import Config
from visctrl.hal.pioneer.reports import Flags, StandardReport
from visctrl.hal.pioneer.subclasses import HEADING_RAD, Subclass
from visctrl.hal.types import STANDSTILL, BaseStatus, Odometry, Pose, Range, Velocity

#: Every firmware's position counter wraps at a multiple of this (15, 16 or more bits).
_POSITION_WRAP = 1 << 15
_HEADING_WRAP = 1 << 12
#: No robot is faster: a longer step between reports means that the counters were set anew.
_TOP_SPEED_M_S = 3.0
_JUMP_MARGIN_M = 0.4
#: Low battery where the firmware names no threshold of its own (V).
_LOW_BATTERY_V = 11.0
#: Below these the wheels count as standing (mm/s).
_STANDING_MM_S = 5
_BUMPERS = 0xFE
_STALLED = 0x01
#: Charge states of a robot on its charger: bulk, overcharge, float, balance.
_CHARGING = frozenset({1, 2, 3, 4})


@dataclass(frozen=True)
class Echo:
    """A sonar range (m) and when it was reported (s)."""

    range_m: float
    stamp: float


class Telemetry:
    """Follows the standard reports of one session.

    The first report is the origin of the odometry; the firmware's own counters survive
    sessions. Position counters are unwrapped modulo 32768, which is right for firmware that
    counts with 15 bits and for firmware that counts with 16.

    Parameters
    ----------
    subclass : Subclass
        What the robot's counters count.
    """

    def __init__(self, subclass: Subclass) -> None:
        self.subclass = subclass
        self._low_battery_v = _LOW_BATTERY_V
        self._last: StandardReport | None = None
        self._heading = 0  # accumulated since the origin, in the firmware's units
        self._origin_heading = 0
        self._x = self._y = 0.0  # ahead of and left of the origin (m), in the firmware's axes
        self._motors_expected = False
        #: When the last report arrived (s).
        self.last_report = float("-inf")
        #: How often the position counters jumped and were taken as a new beginning.
        self.jumps = 0
        self.echoes: dict[int, Echo] = {}
        self.odometry = Odometry(float("-inf"), Pose(0.0, 0.0, 0.0), STANDSTILL)

    def configure(self, config: Config) -> None:
        """Take the thresholds that the robot's configuration names."""
        if config.low_battery:
            self._low_battery_v = config.low_battery / 10.0

    def expect_motors(self) -> None:
        """From now on, motors that are off are a fault."""
        self._motors_expected = True

    def take(self, report: StandardReport, stamp: float) -> None:
        """Take a report that arrived at ``stamp`` (s)."""
        if self._last is None:
            # The first report is the origin; after a restart, the pose so far is.
            self._origin_heading = report.motion.theta - self._heading
        else:
            self._advance(self._last, report, stamp - self.last_report)
        self._last, self.last_report = report, stamp
        self.odometry = Odometry(stamp, self._pose(), self._velocity(report))
        for reading in report.sonar:
            range_m = reading.range * self.subclass.units.range_mm / 1e3
            self.echoes[reading.number] = Echo(range_m, stamp)

    def ranges(self, now: float, oldest: float) -> list[Range]:
        """Return the sonar readings at most ``oldest`` s old; infinite where nothing echoed."""
        ring, found = self.subclass.sonar, []
        if ring is None:
            return []
        for number, echo in sorted(dict(self.echoes).items()):
            if now - echo.stamp <= oldest and number in ring.transducers:
                at = ring.transducers[number]
                distance = echo.range_m if echo.range_m < ring.range_m else math.inf
                age = max(now - echo.stamp, 0.0)
                found.append(Range(-at.left_m, at.forward_m, -at.direction_rad, distance, age))
        return found

    def restart(self) -> None:
        """Go on from the pose so far: the controller has restarted, its counters with it."""
        self._last = None

    @property
    def reported(self) -> bool:
        """Whether there has been a report."""
        return self._last is not None

    @property
    def motors_on(self) -> bool:
        """Whether the last report says that the motors are enabled."""
        return bool(self._flags & Flags.MOTORS)

    @property
    def charging(self) -> bool:
        """Whether the last report says that the robot is on its charger."""
        return self._last is not None and self._last.tail.charge_state in _CHARGING

    @property
    def standing(self) -> bool:
        """Whether the last report shows both wheels at rest."""
        if self._last is None:
            return True
        motion = self._last.motion
        return max(abs(motion.left), abs(motion.right)) < _STANDING_MM_S

    def blockers(self) -> tuple[str, ...]:
        """Return why the wheels must not turn, as sentences."""
        if self._last is None:
            return ()
        motion = self._last.motion
        found = []
        if self._flags & Flags.E_STOP:
            found.append("the emergency stop is pressed")
        if self._flags & Flags.E_STALL:
            found.append("the stop button has stalled the motors")
        elif self._motors_expected and not self.motors_on and not found:
            found.append("the motors have been switched off on the robot")
        if self.charging:
            found.append("the robot is being charged: take it off the charger")
        sides = (("left", motion.rear), ("right", motion.front))
        found += [f"the {name} wheel is stalled" for name, bits in sides if bits & _STALLED]
        bumpers = (("front", motion.front), ("rear", motion.rear))
        found += [f"a {name} bumper is pressed" for name, bits in bumpers if bits & _BUMPERS]
        return tuple(found)

    def status(self) -> BaseStatus:
        """Return the health of the base."""
        if self._last is None:
            return BaseStatus()
        battery = self._last.battery_v
        faults = self.blockers()
        if battery < self._low_battery_v:
            faults += (
                f"the battery is low: {battery:.1f} V, at least {self._low_battery_v:.1f} V needed",
            )
        return BaseStatus(battery, faults)

    @property
    def _flags(self) -> Flags:
        return Flags(self._last.motion.flags if self._last else 0)

    def _advance(self, before: StandardReport, now: StandardReport, dt: float) -> None:
        metres = self.subclass.units.distance_mm / 1e3
        dx = _wrapped(now.motion.x - before.motion.x, _POSITION_WRAP) * metres
        dy = _wrapped(now.motion.y - before.motion.y, _POSITION_WRAP) * metres
        turned = _wrapped(now.motion.theta - before.motion.theta, _HEADING_WRAP)
        if math.hypot(dx, dy) > _TOP_SPEED_M_S * dt + _JUMP_MARGIN_M:
            self.jumps += 1
            # The pose so far stays; the new counters continue from it.
            self._origin_heading = now.motion.theta - self._heading
            return
        self._heading += turned
        origin = self._origin_heading * HEADING_RAD
        c, s = math.cos(origin), math.sin(origin)
        self._x += c * dx + s * dy
        self._y += c * dy - s * dx

    def _pose(self) -> Pose:
        phi = _wrapped(self._heading, _HEADING_WRAP) * HEADING_RAD
        return Pose(-self._y, self._x, phi)

    def _velocity(self, report: StandardReport) -> Velocity:
        left, right = report.motion.left, report.motion.right
        rate = report.tail.turn_rate
        if rate is None:
            omega = (right - left) / 2.0 * self.subclass.arcos.turn_per_difference
        else:
            omega = math.radians(rate / 10.0)
        return Velocity((left + right) / 2e3, omega)


def _wrapped(difference: int, modulus: int) -> int:
    """Return ``difference`` modulo ``modulus`` in (-modulus/2, modulus/2]."""
    half = modulus // 2
    return (difference + half - 1) % modulus - half + 1
