"""The emulator: firmware behind a port, in wall-clock time, in a thread of its own."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from visctrl.hal.emulator.faults import Channel, FaultSchedule
from visctrl.hal.emulator.firmware import Firmware
from visctrl.hal.emulator.ports import Port
from visctrl.hal.emulator.traffic import Traffic
from visctrl.hal.pioneer.packet import StreamDecoder
from visctrl.hal.pioneer.reports import Type
from visctrl.hal.types import Pose, Velocity

#: Longest time between two looks at the line (s). Shorter than the least spacing of commands,
#: so that a client that sends them closer together is found out.
_LOOK_S = 0.004
_RUBBISH_S, _RUBBISH_BYTES = 0.004, 12
_TRUTH_S = 0.05
_NORMAL_BATTERY_V = 12.8

_log = logging.getLogger(__name__)


class Emulator:
    """A robot at the end of a line, as a context manager.

    Parameters
    ----------
    firmware : Firmware
        The robot.
    port : Port
        Where clients connect; closed with the emulator.
    faults : FaultSchedule or None
        What goes wrong.
    traffic : Traffic or None
        Where to record what is received.
    seed : int
        Of the damage to bytes.
    notices_hang_up : bool
        Whether the robot stops at once when a TCP client hangs up, as the vendor's simulator
        does. A robot behind a serial device server does not notice: its watchdog acts.
    companion : callable or None
        Called with the robot's true pose at every look at the line (some hundred times a
        second), for devices that ride on it.
    """

    def __init__(
        self,
        firmware: Firmware,
        port: Port,
        faults: FaultSchedule | None = None,
        traffic: Traffic | None = None,
        seed: int = 0,
        *,
        notices_hang_up: bool = False,
        companion: Callable[[Pose], None] | None = None,
    ) -> None:
        self.url = port.url
        self.faults = faults or FaultSchedule()
        self.traffic = traffic or Traffic()
        self._firmware = firmware
        self._port = port
        self._notices_hang_up = notices_hang_up
        self._companion = companion
        self._to_robot = Channel(self.faults, seed)
        self._to_client = Channel(self.faults, seed + 1)
        self._decoder = StreamDecoder()
        self._origin = time.monotonic()
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="emulator", daemon=True)
        self._looked = self._next_rubbish = self._next_truth = 0.0
        self._was_reset = False
        #: What ended the emulation, if not `close`.
        self.failure: Exception | None = None

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Switch the robot off and release the port."""
        self._stop.set()
        self._thread.join()

    def now(self) -> float:
        """Return the seconds since the robot was made."""
        return time.monotonic() - self._origin

    @property
    def pose(self) -> Pose:
        """True pose of the axle's centre."""
        with self._lock:
            return self._firmware.drive.true_pose

    @property
    def velocity(self) -> Velocity:
        """Present velocity of the wheels."""
        with self._lock:
            return self._firmware.drive.velocity

    @property
    def standing_since(self) -> float | None:
        """When the wheels came to rest (s, on the emulator's clock); None while they turn."""
        with self._lock:
            return self._firmware.standing_since

    @property
    def running(self) -> bool:
        """Whether the robot is switched on."""
        return self._thread.is_alive()

    @property
    def motors(self) -> bool:
        """Whether the motors are enabled."""
        with self._lock:
            return self._firmware.motors

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._port.wait(_LOOK_S)
                with self._lock:
                    self._look(self.now())
        except Exception as error:
            self.failure = error
            _log.exception("the emulator has failed")
        finally:
            self._port.close()

    def _look(self, t: float) -> None:
        """Take what has arrived, live on until ``t`` (s), send what is due."""
        self._apply_faults()
        self._to_robot.put(t, self._port.read())
        if self._port.lost_client() and self._notices_hang_up:
            self._firmware.hang_up()
            self._to_robot.clear()
            self._to_client.clear()
            self._decoder = StreamDecoder()
        for data in self._firmware.advance(t):
            self._to_client.put(t, data)
        arrived = self._to_robot.take(t)
        if "deaf" not in self.faults:
            self._hear(t, arrived)
        self._looked = t
        self._speak(t)
        if self._companion is not None:
            self._companion(self._firmware.drive.true_pose)
        if t >= self._next_truth:
            self._next_truth = t + _TRUTH_S
            drive = self._firmware.drive
            self.traffic.note_truth(t, drive.true_pose, drive.velocity)

    def _hear(self, t: float, arrived: bytes) -> None:
        before = self._decoder.discarded
        for packet in self._decoder.feed(arrived, t):
            self.traffic.add(self._looked, t, packet)
            asked = self._firmware.host_baud
            for reply in self._firmware.receive(packet):
                self._to_client.put(t, reply)
            if (baud := self._firmware.host_baud) is not None and baud != asked:
                self._port.set_rate(baud)
        self.traffic.garbage += self._decoder.discarded - before

    def _speak(self, t: float) -> None:
        data = self._to_client.take(t)
        if "rubbish" in self.faults:
            data = b""
            if t >= self._next_rubbish:
                self._next_rubbish = t + _RUBBISH_S
                data = self._to_client.rubbish(_RUBBISH_BYTES)
        if data and "silent" not in self.faults:
            self._port.write(data)

    def _apply_faults(self) -> None:
        faults, firmware = self.faults, self._firmware
        moved = firmware.first_motion
        faults.update(None if moved is None else self._looked - moved)
        conditions = firmware.conditions
        conditions.stalled = "stall" in faults
        conditions.bumper = "bumper" in faults
        conditions.e_stop = "estop" in faults
        conditions.charging = "charging" in faults
        low = "low-battery" in faults
        conditions.battery_v = faults.value("low-battery") if low else _NORMAL_BATTERY_V
        if "reset" in faults and not self._was_reset:
            for packet in firmware.restart(Type(int(faults.value("reset")))):
                self._to_client.put(self._looked, packet)
        self._was_reset = "reset" in faults
