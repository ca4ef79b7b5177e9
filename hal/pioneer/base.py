"""The driver: a `Base` over a serial line, which never lets the robot run blind or unattended.

A thread of the driver reads the reports and watches. It stops the robot when reports stop
coming, when the robot reports a fault, and when nobody has commanded a moving robot for too
long; it feeds the firmware's watchdog only while the robot stands still. So whatever dies, the
robot stops: the caller (the thread stops it), the process (its guardian stops it, a process of
its own), the line (thread and firmware).
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Sequence

from visctrl.hal.actuation import bounded, quantised
from visctrl.hal.errors import DeviceError, InputError, LinkError
from visctrl.hal.interfaces import Base, Clock
from visctrl.hal.pioneer.commands import Command, Id
from visctrl.hal.pioneer.config import Config
from visctrl.hal.pioneer.handshake import BAUDS
from visctrl.hal.pioneer.link import Link
from visctrl.hal.pioneer.reports import Identity
from visctrl.hal.pioneer.session import UNATTENDED_S, Session
from visctrl.hal.pioneer.settings import BRAKE
from visctrl.hal.pioneer.telemetry import Telemetry
from visctrl.hal.pioneer.timing import LineLoad
from visctrl.hal.types import STANDSTILL, BaseStatus, Odometry, Range, Velocity
from visctrl.robots import Limits, Robot

#: Longest pause between packets; also how often a standing robot's watchdog is fed.
PULSE_S = 0.5

_STANDSTILL_S = 0.8
#: Longest time between two looks at the line, if the machine is not overloaded.
_LISTEN_S = 0.06
# Slower set-points may not overcome friction.
_CRAWL = Velocity(0.02, math.radians(3.0))

_log = logging.getLogger(__name__)


class _DisobedienceError(LinkError):
    """The robot reports, but does not do what it is told: a new session would not help."""


class PioneerBase(Base):
    """A Pioneer robot; one object serves one session.

    Parameters
    ----------
    url : str
        Port (see `Link`).
    robot : Robot
        The robot that is expected at its other end.
    limits : Limits
        Bounds of what `command` sends; also given to the firmware.
    clock : Clock
        Of all stamps.
    bauds : sequence of int
        Line rates to try, the likeliest first.
    sonar : bool
        Whether the sonar rings are switched on.
    reconnect_s : float
        For how long to try and begin a new session after the line has failed; the robot stands
        meanwhile, and commands answer standstill. 0: the failure is final.
    """

    whole_units = True

    def __init__(
        self,
        url: str,
        robot: Robot,
        limits: Limits,
        clock: Clock,
        bauds: Sequence[int] = BAUDS,
        *,
        sonar: bool = True,
        reconnect_s: float = 0.0,
    ) -> None:
        self._link = Link(url, clock)
        self._session = Session(self._link, robot, bauds)
        self._limits = limits
        self._clock = clock
        self._sonar = sonar
        self._reconnect_s = reconnect_s
        self._away = threading.Event()  # the line has failed, and is being opened anew
        self._watcher: threading.Thread | None = None
        self._closing = threading.Event()
        self._connected = False
        self._motion = threading.RLock()  # held while a set-point goes out
        self._set_point = STANDSTILL
        self._commanded_at = -math.inf
        self._obeyed_at = -math.inf
        self._heard_at = self._listened_at = -math.inf
        self._silence = 0.0
        self._braked_for = ""
        self._failure: DeviceError | None = None

    @property
    def identity(self) -> Identity | None:
        """Who the robot is; None before it has answered."""
        contact = self._session.contact
        return None if contact is None else contact.identity

    @property
    def config(self) -> Config | None:
        """What the robot's firmware says of itself; None if it did not answer."""
        return self._session.config

    @property
    def round_trip_s(self) -> float:
        """Time from a packet to its answer (s)."""
        return self._session.timing.round_trip_s

    @property
    def line_load(self) -> LineLoad | None:
        """How much of a serial line the reports take; None where there is no real line."""
        return self._session.load()

    # --- session ---------------------------------------------------------------------------

    def open(self) -> None:
        """Connect, switch the motors on, and start watching. The robot does not move.

        Raises
        ------
        LinkError
            The port cannot be opened, or nothing that is known here answers.
        InputError
            Another robot than the expected one answers.
        BaseFaultError
            The motors cannot be enabled.
        """
        self._link.open()
        self._session.begin()
        self._session.enable(self._limits, sonar=self._sonar)
        self._watcher = threading.Thread(target=self._watch, name="pioneer", daemon=True)
        self._watcher.start()
        self._connected = True

    def inspect(self) -> BaseStatus:
        """Connect to whatever robot there is, learn what it says of itself, and leave it alone.

        Its motors stay off. `identity` and `config` hold the rest.

        Raises
        ------
        LinkError
            As in `open`.
        """
        try:
            self._link.open()
            return self._session.begin(any_robot=True).status()
        finally:
            self.close()

    def close(self) -> None:
        """Stop the robot, switch its motors off, end the session, release the port."""
        if self._away.is_set() and self._watcher is not None:
            self._closing.set()
            self._link.abandoned.set()
            self._watcher.join()
        if not self._link.is_open:
            return
        self._connected = False
        try:
            self._say_goodbye()
        except LinkError as error:
            _log.warning("the robot could not be stopped properly: %s", error)
        finally:
            self._closing.set()
            if self._watcher is not None:
                self._watcher.join()
            self._link.close()

    # --- the interface -----------------------------------------------------------------------

    def command(self, velocity: Velocity) -> Velocity:
        """Set the velocity; return what was sent, in whole mm/s and deg/s.

        While the robot reports a fault, or no report has come lately, that is standstill.

        Raises
        ------
        LinkError
            The line is dead, or the controller has restarted.
        ValueError
            The velocity is not finite.
        """
        if not velocity.finite:
            raise ValueError(f"velocity command is not finite: {velocity}")
        wanted = quantised(bounded(velocity, self._limits), self._limits)
        self._check()
        with self._motion:
            if self._away.is_set():
                return STANDSTILL
            sent = STANDSTILL if self._braked_for else wanted
            try:
                self._send_set_point(sent)
            except LinkError:
                if self._reconnect_s <= 0.0:
                    raise
                return STANDSTILL  # the watching thread finds out, too, and begins anew
        return sent

    def odometry(self) -> Odometry:
        """Return the newest odometry: pose of the axle's centre since `open`."""
        return self._telemetry().odometry

    def status(self) -> BaseStatus:
        """Return battery and faults; a dead line is one, unless it is being opened anew."""
        status = self._telemetry().status()
        if self._away.is_set():
            return BaseStatus(status.battery_v)
        if self._failure is not None:
            return BaseStatus(status.battery_v, (str(self._failure), *status.faults))
        return status

    def stop(self) -> None:
        """Brake as hard as the robot can, and stay at standstill.

        Raises
        ------
        LinkError
            The port does not take bytes.
        """
        with self._motion:
            self._set_point = STANDSTILL
            if not self._away.is_set():  # else it is stopped before anything else is sent
                self._send(*BRAKE)
                self._link.beat(moving=False)

    def echoes(self, max_age_s: float = 1.0) -> dict[int, float]:
        """Return the sonar ranges (m) of the last ``max_age_s``, by transducer number."""
        newest = self._clock.now() - max_age_s
        echoes = dict(self._telemetry().echoes)
        return {number: echo.range_m for number, echo in echoes.items() if echo.stamp >= newest}

    def ranges(self) -> list[Range]:
        """See `Base.ranges`: the sonar rings' echoes of the last second."""
        return self._telemetry().ranges(self._clock.now(), oldest=1.0)

    # --- watching ------------------------------------------------------------------------------

    def _watch(self) -> None:
        while not self._closing.is_set() and self._failure is None:
            try:
                for packet in self._link.receive():
                    self._session.take(packet)
                self._guard(self._telemetry())
            except LinkError as error:
                self._failure = self._recover(error)
            except Exception as error:
                self._failure = LinkError(f"the driver has failed: {error!r}")
                _log.exception("the driver has failed")
        if self._failure is not None and not self._closing.is_set():
            self._try_to_stop()

    def _recover(self, lost: LinkError) -> DeviceError | None:
        """Begin a new session, if that is wanted; return what ends the drive, None for nothing."""
        if self._reconnect_s <= 0.0 or isinstance(lost, _DisobedienceError):
            return lost
        _log.warning("%s: reconnecting for %g s; the robot stands", lost, self._reconnect_s)
        self._try_to_stop()
        deadline = self._clock.now() + self._reconnect_s
        with self._motion:
            self._away.set()
        try:
            again = self._session.renew(self._clock, deadline, self._limits, sonar=self._sonar)
        except DeviceError as error:
            return error
        except InputError as error:
            return LinkError(str(error))
        if not again:
            return lost
        _log.warning("connected again")
        now = self._clock.now()
        with self._motion:
            self._heard_at, self._silence, self._listened_at, self._obeyed_at = now, 0.0, now, now
            self._away.clear()
        return None

    def _guard(self, telemetry: Telemetry) -> None:
        """Brake or give up if something is wrong; feed the watchdog of a standing robot."""
        now = self._clock.now()
        silence = self._listen(telemetry, now)
        if silence > self._session.timing.silent_s:
            raise LinkError(f"the robot has not reported for {silence:.1f} s")
        self._check_obedience(telemetry, now)
        blockers = telemetry.blockers()
        blind = "reports are missing" if silence > self._session.timing.blind_s else ""
        trouble = blockers[0] if blockers else blind
        with self._motion:
            if trouble and not self._braked_for:
                self.stop()
                _log.warning("stopped: %s", trouble)
            self._braked_for = trouble
            moving = self._set_point != STANDSTILL
            if moving and now - self._commanded_at > UNATTENDED_S:
                self.stop()
                _log.warning("stopped: no command for %.1f s", UNATTENDED_S)
            elif not moving and now - self._link.last_sent > PULSE_S:
                self._send(Command(Id.PULSE))

    def _listen(self, telemetry: Telemetry, now: float) -> float:
        """Return for how long (s) this thread has listened without a report.

        Time that it was not scheduled does not count: reports may be waiting to be read.
        """
        elapsed, self._listened_at = now - self._listened_at, now
        if telemetry.last_report > self._heard_at:
            self._heard_at, self._silence = telemetry.last_report, 0.0
        else:
            self._silence += min(elapsed, _LISTEN_S)
        return self._silence

    def _check_obedience(self, telemetry: Telemetry, now: float) -> None:
        if _idle(self._set_point) or not telemetry.standing:
            self._obeyed_at = now
        elif now - self._obeyed_at > (limit := self._session.timing.disobedient_s):
            raise _DisobedienceError(
                f"the robot reports, but has not moved for {limit:.1f} s although told to: "
                "it does not hear, or something holds it"
            )

    def _try_to_stop(self) -> None:
        try:
            self.stop()
        except LinkError as error:
            _log.warning("no stop command could be sent (%s); the robot's watchdog acts", error)

    # --- sending ---------------------------------------------------------------------------------

    def _send_set_point(self, velocity: Velocity) -> None:
        speed, turn = round(velocity.v * 1e3), round(math.degrees(velocity.omega))
        moving = velocity != STANDSTILL
        if moving:  # the guardian knows before the robot does
            self._link.beat(moving=True)
        self._send(Command(Id.VEL, speed), Command(Id.RVEL, turn))
        if not moving:
            self._link.beat(moving=False)
        now = self._clock.now()
        if _idle(self._set_point):
            self._obeyed_at = now
        self._set_point, self._commanded_at = velocity, now

    def _send(self, *commands: Command) -> None:
        """Send commands; after a pause, the set-points are taken back first (see `Link`)."""
        with self._motion:
            if self._link.send(*commands):
                self._set_point = STANDSTILL

    def _say_goodbye(self) -> None:
        if self.identity is None:
            return  # nobody has answered: there is nobody to talk to
        if self._session.telemetry is not None:
            self.stop()
            self._await_standstill(self._session.telemetry)
            self._send(Command(Id.ENABLE, 0))
            self._session.restore_baud()
        self._send(Command(Id.CLOSE))

    def _await_standstill(self, telemetry: Telemetry) -> None:
        deadline = self._clock.now() + _STANDSTILL_S
        while self._watching and not telemetry.standing and self._clock.now() < deadline:
            self._clock.sleep_until(self._clock.now() + 0.01)

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure
        if not self._connected:
            raise LinkError(f"the robot on {self._link.url} is not connected")

    @property
    def _watching(self) -> bool:
        return self._watcher is not None and self._watcher.is_alive()

    def _telemetry(self) -> Telemetry:
        if self._session.telemetry is None:
            raise LinkError(f"the robot on {self._link.url} is not connected")
        return self._session.telemetry


def _idle(set_point: Velocity) -> bool:
    """Return whether a set-point may leave the wheels where they are."""
    return abs(set_point.v) < _CRAWL.v and abs(set_point.omega) < _CRAWL.omega
