"""A session with a robot's controller: from the first contact to motors that are switched on.

On a line that damages packets every step is repeated: a command has no acknowledgement, so what
it should lead to is waited for, and it is sent again if that stays out.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from visctrl.hal.errors import BaseFaultError, InputError, LinkError
from visctrl.hal.interfaces import Clock
from visctrl.hal.pioneer.commands import HOST_BAUD_CODES, Command, Id
from visctrl.hal.pioneer.config import Config, decode_config
from visctrl.hal.pioneer.handshake import Contact, connect
from visctrl.hal.pioneer.link import Link
from visctrl.hal.pioneer.packet import OVERHEAD, Packet
from visctrl.hal.pioneer.reports import (
    RESET_TYPES,
    ReportError,
    Type,
    decode_standard_report,
    is_standard_report,
)
from visctrl.hal.pioneer.settings import BRAKE, REST, settings
from visctrl.hal.pioneer.subclasses import expected_subclass, find_subclass, subclasses_of
from visctrl.hal.pioneer.telemetry import Telemetry
from visctrl.hal.pioneer.timing import SLOW_S, LineLoad, Timing
from visctrl.robots import Limits, Robot

#: A moving robot that has not been commanded for so long is stopped.
UNATTENDED_S = 0.4

_OPEN_TRIES, _FIRST_REPORT_S = 6, 0.4
_CONTACTS = 3
#: Value of the parameter AutoBaud that lets a client choose the rate, and how long to listen.
_AUTO_BAUD, _SWITCHED_S = 2, 0.9
#: Share of the reports that a line at a new rate must pass.
_NEARLY_ALL = 0.8
#: How often the robot is called back from a rate at which it is not heard.
_RETURNS = 6
#: Between two attempts to begin anew (s).
_PAUSE_S = 0.25
_CONFIG_TRIES, _CONFIG_S = 6, 0.2
_ENABLE_TRIES, _ENABLE_S = 5, 0.5

_log = logging.getLogger(__name__)


class Session:
    """A session over an open link, and those that follow it when the line has failed.

    Parameters
    ----------
    link : Link
        Open.
    robot : Robot
        The robot that is expected at its other end, or that is looked for first.
    bauds : sequence of int
        Line rates to try, the likeliest first.
    """

    def __init__(self, link: Link, robot: Robot, bauds: Sequence[int]) -> None:
        self._link = link
        self._robot = robot
        self._bauds = bauds
        self._config: Config | None = None
        self._report_bytes = 0
        self._found_baud: int | None = None
        self.contact: Contact | None = None
        self.telemetry: Telemetry | None = None
        self.timing = Timing()

    @property
    def config(self) -> Config | None:
        """What the robot's firmware says of itself; None if it did not answer."""
        return self._config

    def begin(self, *, any_robot: bool = False) -> Telemetry:
        """Connect, open, wait for a first report, ask for the configuration. Motors stay off.

        Raises
        ------
        LinkError
            Nothing that is known here answers, or it never reports.
        InputError
            Another robot than the expected one answers.
        """
        telemetry = self._open(any_robot)
        self._configure(telemetry)
        if not any_robot:
            self._raise_baud(telemetry)
        self._warn()
        return telemetry

    def enable(self, limits: Limits, *, sonar: bool) -> None:
        """Give the firmware its limits and switch the motors on; the robot stands.

        Raises
        ------
        BaseFaultError
            The motors cannot be enabled; the message says why.
        """
        telemetry = self.telemetry
        assert telemetry is not None
        if telemetry.charging:  # some controllers would drive off all the same
            raise BaseFaultError("the robot is being charged: take it off the charger")
        self._link.guard(BRAKE, UNATTENDED_S)
        for _ in range(_ENABLE_TRIES):
            # Again with each attempt: what a damaged command should have set, nobody reports.
            self._link.send(*settings(limits, self._config or Config(), sonar=sonar))
            self._link.send(Command(Id.ENABLE, 1))
            if self._wait(_ENABLE_S + self.timing.round_trip_s, lambda: telemetry.motors_on):
                telemetry.expect_motors()
                return
        why = "; ".join(telemetry.blockers()) or "press the MOTORS button on the robot"
        raise BaseFaultError(f"the motors cannot be enabled: {why}")

    def renew(self, clock: Clock, deadline: float, limits: Limits, *, sonar: bool) -> bool:
        """Begin anew after the line has failed; attempts begin until ``deadline`` (s).

        Odometry goes on: the controller's counters survive sessions, and where it says that it
        has restarted, the pose so far is kept. Return whether the motors are on again.

        Raises
        ------
        BaseFaultError, InputError
            The robot answers, but cannot go on, or is another one.
        """
        if self._link.baud is not None:
            self._bauds = (self._link.baud,)
        while clock.now() < deadline and not self._link.abandoned.is_set():
            self._link.close()
            clock.sleep_until(clock.now() + _PAUSE_S)
            try:
                self._link.open()
                self.begin()
                self.enable(limits, sonar=sonar)
            except LinkError as error:
                _log.info("not yet: %s", error)
            else:
                return True
        return False

    def take(self, packet: Packet) -> None:
        """Take a packet from the robot.

        Raises
        ------
        LinkError
            It says that the controller has restarted.
        """
        telemetry = self.telemetry
        assert telemetry is not None
        try:
            if is_standard_report(packet):
                telemetry.take(decode_standard_report(packet), packet.stamp)
                self._report_bytes = max(self._report_bytes, len(packet.data) + OVERHEAD)
            elif packet.id == Type.CONFIG and self._config is None:
                self._config = decode_config(packet)
                telemetry.configure(self._config)
            elif packet.id in RESET_TYPES:
                telemetry.restart()
                raise LinkError("the robot's controller has restarted: its session is lost")
        except ReportError as error:
            _log.warning("ignored: %s", error)

    def _open(self, any_robot: bool) -> Telemetry:
        """Bring the robot to report, from contact to contact."""
        if not any_robot and not subclasses_of(self._robot):
            raise InputError(
                f"robot '{self._robot.name}' speaks no ARCOS: its robot.yaml has no section 'arcos'"
            )
        self._link.after_pause = ()
        for _ in range(_CONTACTS):
            self.contact = contact = connect(self._link, self._bauds)
            name = contact.identity.subclass
            if any_robot:
                subclass = find_subclass(name, (self._robot,))
            else:
                subclass = expected_subclass(name, self._robot, self._link.url)
            telemetry = self.telemetry
            if telemetry is None or telemetry.subclass != subclass:
                self.telemetry = telemetry = Telemetry(subclass)
            if self._reports(telemetry, _FIRST_REPORT_S + contact.round_trip_s):
                # A robot whose watchdog has acted drives on with its old set-points as soon as
                # any packet arrives: from here on, those are taken back first. Not before: to a
                # robot that waits for OPEN any other packet is the end of the exchange.
                self._link.after_pause = REST
                return telemetry
        raise LinkError(f"port {self._link.url}: the robot opens a session but never reports")

    def _reports(self, telemetry: Telemetry, patience: float) -> bool:
        """Open the session; return whether it reports."""
        before = telemetry.last_report
        for _ in range(_OPEN_TRIES):
            self._link.send(Command(Id.OPEN))
            if self._wait(patience, lambda: telemetry.last_report > before):
                return True
        return False

    def _configure(self, telemetry: Telemetry) -> None:
        assert self.contact is not None
        round_trip = self.contact.round_trip_s
        for _ in range(_CONFIG_TRIES):
            self._link.send(Command(Id.CONFIG))
            if self._wait(_CONFIG_S + round_trip, lambda: self._config is not None):
                break
        else:
            _log.warning("the robot does not tell its configuration; its own limits are unknown")
        cycle = self._config.report_cycle if self._config is not None else None
        self.timing = Timing.of(cycle, round_trip)

    def _raise_baud(self, telemetry: Telemetry) -> None:
        """Take the lowest rate of the line that the reports do not fill.

        Where the robot's parameter AutoBaud allows it, as the vendor's library does. Step by
        step: a controller at a rate that the line does not pass can hardly be called back.

        Raises
        ------
        LinkError
            The robot is not heard at a new rate, and no longer at the old one.
        """
        config, link = self._config, self._link
        if config is None or link.baud is None or config.auto_baud != _AUTO_BAUD:
            return
        found = last = link.baud
        for baud in (rate for rate in sorted(HOST_BAUD_CODES) if rate > found):
            if (load := self.load()) is None or not load.heavy:
                return
            link.switch_baud(baud, _host_baud(baud))
            if not self._carries(telemetry):
                if not self._called_back(last, baud, telemetry):
                    raise LinkError(
                        f"port {link.url}: the robot no longer answers after a change to {baud} "
                        "baud: restart it, and set its parameter AutoBaud to 0"
                    )
                return
            last, self._found_baud = baud, found
            _log.info("the line now runs at %d baud", baud)

    def _called_back(self, last: int, tried: int, telemetry: Telemetry) -> bool:
        """Bring line and robot back to the last rate; return whether it is heard there."""
        for _ in range(_RETURNS):
            self._link.set_baud(last)  # the robot may not have heard of the new one
            if self._hears(telemetry):
                return True
            self._link.set_baud(tried)
            self._link.switch_baud(last, _host_baud(last))
        return self._hears(telemetry)

    def _carries(self, telemetry: Telemetry) -> bool:
        """Return whether the line passes nearly all reports at its new rate."""
        if not self._hears(telemetry):
            return False
        heard, cycles = 0, 10
        for packet in self._link.receive_for(cycles * self.timing.cycle_s):
            self.take(packet)
            heard += is_standard_report(packet)
        return heard >= _NEARLY_ALL * cycles

    def _hears(self, telemetry: Telemetry) -> bool:
        """Return whether reports come."""
        before = telemetry.last_report
        self._link.send(Command(Id.PULSE))
        return self._wait(_SWITCHED_S, lambda: telemetry.last_report > before)

    def restore_baud(self) -> None:
        """Leave the line at the rate at which it was found."""
        if self._found_baud is not None:
            baud, self._found_baud = self._found_baud, None
            self._link.switch_baud(baud, _host_baud(baud))

    def _warn(self) -> None:
        """Say what is unusual about the line."""
        timing = self.timing
        if timing.round_trip_s > SLOW_S:
            _log.warning(
                "the line to the robot is slow: it answers after %.2f s", timing.round_trip_s
            )
        if (load := self.load()) is not None and load.heavy:
            _log.warning("%s", load)

    def load(self) -> LineLoad | None:
        """Return how much of the line the reports take; None where there is no real line."""
        baud = self._link.baud
        return None if baud is None else LineLoad(baud, self._report_bytes, self.timing.cycle_s)

    def _wait(self, seconds: float, done: Callable[[], bool]) -> bool:
        """Read until ``done()`` or for ``seconds``; only while nobody else reads."""
        for packet in self._link.receive_for(seconds):
            self.take(packet)
            if done():
                return True
        return False


def _host_baud(baud: int) -> Command:
    return Command(Id.HOSTBAUD, HOST_BAUD_CODES[baud])
