"""How a run ends: a robot that stands, and what an exception makes of it."""

from __future__ import annotations

import traceback

from visctrl.hal.errors import DeviceError
from visctrl.hal.interfaces import Backend
from visctrl.robots.errors import VisctrlError
from visctrl.runtime.interrupts import Interrupted
from visctrl.runtime.overdue import PluginOverdueError
from visctrl.runtime.pipeline import PluginError
from visctrl.runtime.safety import LostError
from visctrl.runtime.stop import StopRequested
from visctrl.runtime.summary import FAULT, LOST, STOPPED, End

_KEYBOARD_INTERRUPT = 130
#: Slower than this, the robot stands (m/s, rad/s).
STANDING = (1e-3, 2e-3)


def settle(backend: Backend, period_s: float, longest_s: float) -> None:
    """Wait until the robot stands: two odometry reports in a row, or the time allowed."""
    clock = backend.clock
    deadline = clock.now() + longest_s
    standing = 0
    while standing < 2 and clock.now() < deadline:
        clock.sleep_until(clock.now() + period_s)
        velocity = backend.base.odometry().velocity
        still = abs(velocity.v) < STANDING[0] and abs(velocity.omega) < STANDING[1]
        standing = standing + 1 if still else 0


def ended_by(error: BaseException) -> End:
    """Return what an exception makes of a run."""
    if isinstance(error, Interrupted):
        return End(STOPPED, str(error), error.exit_code)
    if isinstance(error, StopRequested):
        return End(STOPPED, str(error), _KEYBOARD_INTERRUPT)
    if isinstance(error, PluginOverdueError):
        return End(FAULT, str(error), PluginError.exit_code)
    if isinstance(error, KeyboardInterrupt):
        return End(STOPPED, "stopped by Ctrl-C", _KEYBOARD_INTERRUPT)
    if isinstance(error, LostError):
        return End(LOST, str(error), 1)
    if isinstance(error, PluginError):
        return End(FAULT, str(error), error.exit_code, error.details)
    details = "".join(traceback.format_exception(error))
    if isinstance(error, VisctrlError):
        return End(FAULT, str(error), DeviceError.exit_code, details)
    reason = f"internal error: {type(error).__name__}: {error}"
    return End(FAULT, reason, DeviceError.exit_code, details)
