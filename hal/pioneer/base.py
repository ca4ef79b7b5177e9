"""The driver: a `Base` over a serial line, which never lets the robot run blind or unattended.

A thread of the driver reads the reports and watches. It stops the robot when reports stop
coming, when the robot reports a fault, and when nobody has commanded a moving robot for too
long; it feeds the firmware's watchdog only while the robot stands still. So whatever dies, the
robot stops: the caller (the thread stops it), the process (the firmware does), the line (both).
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Sequence

from visctrl.hal.actuation import bounded, quantised
from visctrl.hal.errors import BaseFaultError, DeviceError, InputError, LinkError
from visctrl.hal.interfaces import Base, Clock
from visctrl.hal.pioneer.commands import Command, Id
from visctrl.hal.pioneer.config import Config, decode_config
from visctrl.hal.pioneer.handshake import BAUDS, connect
from visctrl.hal.pioneer.link import Link
from visctrl.hal.pioneer.packet import Packet
from visctrl.hal.pioneer.reports import (
    RESET_TYPES,
    Identity,
    ReportError,
    Type,
    decode_standard_report,
    is_standard_report,
)
from visctrl.hal.pioneer.settings import REST, settings
from visctrl.hal.pioneer.subclasses import expected_subclass, find_subclass, subclasses_of
from visctrl.hal.pioneer.telemetry import Telemetry
from visctrl.hal.types import STANDSTILL, BaseStatus, Odometry, Range, Velocity
from visctrl.robots import Limits, Robot

#: Without a report for so long, the robot is stopped: three reports in a row are missing.
BLIND_S = 0.35
#: Without a report for so long, the line counts as dead.
SILENT_S = 0.5
#: A moving robot that has not been commanded for so long is stopped.
UNATTENDED_S = 0.4
#: A robot that stands for so long although told to move does not hear, or cannot move.
DISOBEDIENT_S = 1.5
#: Longest pause between packets; also how often a standing robot's watchdog is fed.
PULSE_S = 0.5

_FIRST_REPORT_S = 1.0
_CONFIG_TRIES, _CONFIG_S = 5, 0.2
_ENABLE_TRIES, _ENABLE_S = 4, 0.5
_STANDSTILL_S = 0.8
#: Longest time between two looks at the line, if the machine is not overloaded.
_LISTEN_S = 0.06
# Slower set-points may not overcome friction.
_CRAWL = Velocity(0.02, math.radians(3.0))

_log = logging.getLogger(__name__)


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
    ) -> None:
        self._link = Link(url, clock)
        self._robot = robot
        self._limits = limits
        self._clock = clock
        self._bauds = bauds
        self._sonar = sonar
        self._telemetry: Telemetry | None = None
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
        self.identity: Identity | None = None
        #: What the robot's firmware says of itself; None if it did not answer.
        self.config: Config | None = None

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
        telemetry = self._meet(self._robot)
        self._send(*settings(self._limits, self.config or Config(), sonar=self._sonar))
        self._enable(telemetry)
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
            return self._meet(None).status()
        finally:
            self.close()

    def close(self) -> None:
        """Stop the robot, switch its motors off, end the session, release the port."""
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
            sent = STANDSTILL if self._braked_for else wanted
            self._send_set_point(sent)
        return sent

    def odometry(self) -> Odometry:
        """Return the newest odometry: pose of the axle's centre since `open`."""
        return self._session().odometry

    def status(self) -> BaseStatus:
        """Return battery and faults; a dead line is one."""
        status = self._session().status()
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
            self._send(Command(Id.E_STOP), *REST)
            self._set_point = STANDSTILL

    def echoes(self, max_age_s: float = 1.0) -> dict[int, float]:
        """Return the sonar ranges (m) of the last ``max_age_s``, by transducer number."""
        newest = self._clock.now() - max_age_s
        echoes = dict(self._session().echoes)
        return {number: echo.range_m for number, echo in echoes.items() if echo.stamp >= newest}

    def ranges(self) -> list[Range]:
        """See `Base.ranges`: the sonar rings' echoes of the last second."""
        return self._session().ranges(self._clock.now(), oldest=1.0)

    # --- connecting --------------------------------------------------------------------------

    def _meet(self, expected: Robot | None) -> Telemetry:
        """Open port and session; ``expected`` is the robot that must be there."""
        if expected is not None and not subclasses_of(expected):
            raise InputError(
                f"robot '{expected.name}' speaks no ARCOS: its robot.yaml has no section 'arcos'"
            )
        self._link.open()
        self.identity = identity = connect(self._link, self._bauds)
        if expected is None:
            subclass = find_subclass(identity.subclass, (self._robot,))
        else:
            subclass = expected_subclass(identity.subclass, expected, self._link.url)
        self._telemetry = Telemetry(subclass)
        self._begin_session(self._telemetry)
        return self._telemetry

    def _begin_session(self, telemetry: Telemetry) -> None:
        """Open the session, wait for a first report, ask for the configuration.

        A robot whose watchdog has acted drives on with its old set-points as soon as any packet
        arrives: from here on, those are taken back first.
        """
        self._link.after_pause = REST
        self._send(Command(Id.OPEN))
        if not self._wait(_FIRST_REPORT_S, lambda: telemetry.reported):
            raise LinkError(f"port {self._link.url}: the robot opens a session but never reports")
        for _ in range(_CONFIG_TRIES):
            self._send(Command(Id.CONFIG))
            if self._wait(_CONFIG_S, lambda: self.config is not None):
                return
        _log.warning("the robot does not tell its configuration; its own limits are unknown")

    def _enable(self, telemetry: Telemetry) -> None:
        for _ in range(_ENABLE_TRIES):
            self._send(Command(Id.ENABLE, 1))
            if self._wait(_ENABLE_S, lambda: telemetry.motors_on):
                telemetry.expect_motors()
                return
        why = "; ".join(telemetry.blockers()) or "press the MOTORS button on the robot"
        raise BaseFaultError(f"the motors cannot be enabled: {why}")

    def _wait(self, seconds: float, done: Callable[[], bool]) -> bool:
        """Read until ``done()`` or for ``seconds``; only while nobody else reads."""
        for packet in self._link.receive_for(seconds):
            self._take(packet)
            if done():
                return True
        return False

    # --- watching ------------------------------------------------------------------------------

    def _watch(self) -> None:
        while not self._closing.is_set() and self._failure is None:
            try:
                for packet in self._link.receive():
                    self._take(packet)
                self._guard(self._session())
            except LinkError as error:
                self._failure = error
            except Exception as error:
                self._failure = LinkError(f"the driver has failed: {error!r}")
                _log.exception("the driver has failed")
        if self._failure is not None and not self._closing.is_set():
            self._try_to_stop()

    def _take(self, packet: Packet) -> None:
        telemetry = self._session()
        try:
            if is_standard_report(packet):
                telemetry.take(decode_standard_report(packet), packet.stamp)
            elif packet.id == Type.CONFIG and self.config is None:
                self.config = decode_config(packet)
                telemetry.configure(self.config)
            elif packet.id in RESET_TYPES:
                raise LinkError("the robot's controller has restarted: its session is lost")
        except ReportError as error:
            _log.warning("ignored: %s", error)

    def _guard(self, telemetry: Telemetry) -> None:
        """Brake or give up if something is wrong; feed the watchdog of a standing robot."""
        now = self._clock.now()
        silence = self._listen(telemetry, now)
        if silence > SILENT_S:
            raise LinkError(f"the robot has not reported for {silence:.1f} s")
        self._check_obedience(telemetry, now)
        blockers = telemetry.blockers()
        trouble = blockers[0] if blockers else "reports are missing" if silence > BLIND_S else ""
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
        elif now - self._obeyed_at > DISOBEDIENT_S:
            raise LinkError(
                f"the robot reports, but has not moved for {DISOBEDIENT_S:.1f} s although told to: "
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
        self._send(Command(Id.VEL, speed), Command(Id.RVEL, turn))
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
        if self._telemetry is not None:
            self.stop()
            self._await_standstill(self._telemetry)
            self._send(Command(Id.ENABLE, 0))
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

    def _session(self) -> Telemetry:
        if self._telemetry is None:
            raise LinkError(f"the robot on {self._link.url} is not connected")
        return self._telemetry


def _idle(set_point: Velocity) -> bool:
    """Return whether a set-point may leave the wheels where they are."""
    return abs(set_point.v) < _CRAWL.v and abs(set_point.omega) < _CRAWL.omega
