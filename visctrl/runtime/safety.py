"""What stands between a controller and the base, whatever the plugins do."""

from __future__ import annotations

import math

from visctrl.contracts import Health
from visctrl.hal.actuation import Limiter
from visctrl.hal.errors import StaleFrameError
from visctrl.hal.types import STANDSTILL, Frame, Velocity
from visctrl.robots import Limits, Robot
from visctrl.robots.errors import InputError, VisctrlError
from visctrl.runtime.config import SafetyOptions


class LostError(VisctrlError):
    """The features did not come back in time."""


class UnsafeCommandError(VisctrlError):
    """A controller asked for something that is not a velocity."""

    exit_code = 3


def effective_limits(robot: Robot, options: SafetyOptions, origin: str) -> Limits:
    """Return the robot's operating limits with those of ``options`` in their place.

    A wheel is as fast as the robot at its top speed straight ahead.

    Raises
    ------
    InputError
        One is above what the robot's hardware can do.
    """
    changes = {
        "wheel_m_s": robot.hardware.v_m_s,
        "track_m": robot.wheels.effective_track_m,
    }
    for name in ("v_m_s", "omega_deg_s", "acceleration_m_s2", "angular_acceleration_deg_s2"):
        wanted = getattr(options, name)
        if wanted is None:
            continue
        most = getattr(robot.hardware, name)
        if wanted > most:
            raise InputError(
                f"{origin}: key 'safety.{name}': at most {most:g} for robot '{robot.name}' "
                f"(got {wanted:g})"
            )
        changes[name] = wanted
    return robot.operating.model_copy(update=changes)


class Guard:
    """Judges frames, estimates and commands; one per run.

    Parameters
    ----------
    limiter : Limiter
        Makes of a velocity what the base can execute.
    options : SafetyOptions
        Ages and timeouts.
    period : float
        Nominal tick (s): the time that the first command's ramp counts on.
    """

    def __init__(self, limiter: Limiter, options: SafetyOptions, period: float) -> None:
        self._limiter = limiter
        self._options = options
        self._period = period
        self._sent = STANDSTILL
        self._sent_at: float | None = None
        self._seen_at: float | None = None

    @property
    def max_command_age(self) -> float:
        """Greatest age of a command that moves the robot (s)."""
        return self._options.max_command_age_s

    def begin(self, now: float) -> None:
        """Start a stage: the robot stands, and features count as seen now."""
        self._limiter.stop()
        self._sent = STANDSTILL
        self._sent_at = None
        self._seen_at = now

    def too_old(self, frame: Frame, now: float) -> bool:
        """Return whether a frame is no view of the present at ``now`` (s): old, or of no time."""
        return not abs(now - frame.stamp) <= self._options.max_frame_age_s

    def frame_problem(self, frame: Frame, now: float) -> str:
        """Return why a frame must not be used at ``now`` (s), empty if it may be.

        Raises
        ------
        StaleFrameError
            The camera has delivered nothing newer for too long.
        """
        if not self.too_old(frame, now):
            return ""
        age = now - frame.stamp
        if not math.isfinite(age):
            return f"the frame's stamp is not a time: {frame.stamp}"
        if age < 0.0:
            return f"the frame's stamp lies {-age:.2f} s ahead"
        if age > self._options.frozen_timeout_s:
            raise StaleFrameError(
                f"the camera has frozen: its newest frame is {age:.1f} s old (allowed "
                f"{self._options.frozen_timeout_s:g} s)"
            )
        return f"frame is {age:.2f} s old"

    def must_hold(self, health: Health, reason: str, now: float) -> bool:
        """Return whether the robot must stand still for want of features.

        Raises
        ------
        LostError
            They have been missing for too long.
        """
        if health is not Health.LOST:
            self._seen_at = now
            return False
        if self._seen_at is None:
            self._seen_at = now
        if now - self._seen_at > self._options.lost_timeout_s:
            waited = f"for {self._options.lost_timeout_s:g} s"
            raise LostError(f"features lost {waited}" + (f": {reason}" if reason else ""))
        return True

    def permit(self, wanted: Velocity, now: float) -> Velocity:
        """Return what may be sent in place of ``wanted`` (see `Limiter`).

        Raises
        ------
        UnsafeCommandError
            The velocity is not finite.
        """
        if not wanted.finite:
            raise UnsafeCommandError(f"velocity is not finite: v {wanted.v}, omega {wanted.omega}")
        dt = self._period if self._sent_at is None else now - self._sent_at
        return self._limiter.limit(wanted, dt)

    def was_sent(self, sent: Velocity, now: float) -> None:
        """Note what the base was told."""
        self._limiter.was_sent(sent)
        self._sent = sent
        self._sent_at = now

    def expired(self, now: float) -> bool:
        """Return whether the command in force is too old to leave a robot moving."""
        return (
            self._sent_at is not None
            and self._sent != STANDSTILL
            and now - self._sent_at > self._options.max_command_age_s
        )
