"""An emulated robot and a camera on simulated time, for the real driver and the whole program."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
import serial
import yaml
from numpy.typing import NDArray
from virtual_time import VirtualTime

import visctrl.hal.cameras.capture
import visctrl.hal.clock
import visctrl.hal.emulator.emulator
import visctrl.hal.pioneer.base
import visctrl.hal.pioneer.link
import visctrl.runtime.watchdog
from visctrl.hal.emulator.emulator import Emulator
from visctrl.hal.emulator.firmware import Firmware
from visctrl.hal.emulator.firmware_profile import ARCOS, Personality, emulated, profile
from visctrl.hal.emulator.ports import Port
from visctrl.hal.emulator.world import World
from visctrl.hal.types import Velocity

#: Where code keeps time that simulated time must reach.
_MODULES: tuple[ModuleType, ...] = (
    visctrl.hal.cameras.capture,
    visctrl.hal.clock,
    visctrl.hal.pioneer.base,
    visctrl.hal.emulator.emulator,
    visctrl.hal.pioneer.link,
    visctrl.runtime.watchdog,
)
_CHUNK = 4096


def keep_time(world: VirtualTime, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the driver, the emulator, the camera and the run live on simulated time."""
    for module in _MODULES:
        for name in ("time", "threading"):
            if hasattr(module, name):
                monkeypatch.setattr(module, name, getattr(world, name))


class Line:
    """A serial line or TCP connection: the robot's end as a `Port`, the client's as pyserial's.

    Parameters
    ----------
    world : VirtualTime
        When bytes arrive.
    url : str
        ``socket://`` notices when its client hangs up; a terminal does not.
    """

    def __init__(self, world: VirtualTime, url: str) -> None:
        self.world = world
        self.url = url
        self.down, self.up = bytearray(), bytearray()  # to the robot, to the client
        self.open = False
        #: Rate of the robot's end; at any other only noise passes. None: all rates will do.
        self.baud: int | None = None
        self.client_baud = 9600
        self._written = 0
        #: Rates at which the line passes but every fourth packet.
        self.too_fast: frozenset[int] = frozenset()
        #: What becomes of what a client writes, packet by packet.
        self.spoil: Callable[[bytes], bytes] = lambda data: data
        self.hung_up = False
        self.client_lost = False

    def connect(self, **options: object) -> Client:
        """Open the client's end."""
        assert options.get("exclusive") is True
        if self.open:
            raise serial.SerialException("Could not exclusively lock port")
        self.open = True
        self.up.clear()
        return Client(self, float(str(options["timeout"])))

    def through(self, data: bytes, baud: int) -> bytes:
        """Return what bytes become on the way between two ends."""
        if self.baud is None:
            return data
        self._written += 1
        passes = baud not in self.too_fast or self._written % 4 == 0
        if self.baud == baud and passes:
            return data
        return bytes((byte * 37 + 11) & 0xFF for byte in data)

    def port(self) -> RobotEnd:
        """Return the robot's end."""
        return RobotEnd(self)


class RobotEnd(Port):
    """Of a `Line`."""

    def __init__(self, line: Line) -> None:
        self.url = line.url
        self._line = line

    def wait(self, seconds: float) -> None:
        self._line.world.wait(lambda: bool(self._line.down), seconds)

    def read(self) -> bytes:
        return _taken(self._line.down, _CHUNK)

    def write(self, data: bytes) -> None:
        passed = self._line.through(data, self._line.client_baud)
        self._line.up += passed[: _CHUNK - len(self._line.up)]

    def set_rate(self, baud: int) -> None:
        if self._line.baud is not None:
            self._line.baud = baud

    def close(self) -> None:
        self._line.hung_up = True

    def lost_client(self) -> bool:
        lost, self._line.client_lost = self._line.client_lost, False
        return lost and self._line.url.startswith("socket:")


class Client:
    """What `serial.serial_for_url` returns for a `Line`."""

    def __init__(self, line: Line, timeout: float) -> None:
        self._line = line
        self._timeout = timeout
        self.baudrate = 9600

    def read(self, size: int) -> bytes:
        line = self._line
        line.world.wait(lambda: len(line.up) >= size or line.hung_up, self._timeout)
        if line.hung_up and not line.up:
            raise serial.SerialException("socket disconnected")
        return _taken(line.up, size)

    def write(self, data: bytes) -> None:
        if self._line.hung_up:
            raise BrokenPipeError(32, "Broken pipe")
        self._line.down += self._line.through(self._line.spoil(data), self.baudrate)

    def flush(self) -> None:
        pass

    @property
    def baudrate(self) -> int:
        return self._line.client_baud

    @baudrate.setter
    def baudrate(self, baud: int) -> None:
        self._line.client_baud = baud

    def reset_input_buffer(self) -> None:
        self._line.up.clear()

    def close(self) -> None:
        self._line.open = False
        self._line.client_lost = True


def _taken(buffer: bytearray, count: int) -> bytes:
    data = bytes(buffer[:count])
    del buffer[:count]
    return data


@dataclass
class Ports:
    """All lines there are; stands in for `serial.serial_for_url`."""

    lines: dict[str, Line] = field(default_factory=dict)

    def serial_for_url(self, url: str, **options: object) -> Client:
        if url not in self.lines:
            raise serial.SerialException(2, f"could not open port {url}: No such file or directory")
        return self.lines[url].connect(**options)


@dataclass
class Film:
    """A camera whose pictures are noise, over a scene or over nothing; and what is wrong with it.

    scene : what it sees. frozen : no picture comes any more. dropped : nor does a connection.
    size : of the pictures.
    opened, released : how often.
    """

    world: VirtualTime
    size: tuple[int, int] = (160, 120)
    scene: NDArray[np.uint8] | None = None
    rate: float = 10.0
    frozen: bool = False
    dropped: bool = False
    opened: int = 0
    released: int = 0

    def capture(self, source: object, *options: object) -> Capture:
        """Stand in for `cv2.VideoCapture`."""
        return Capture(self, source)


class Capture:
    """What `cv2.VideoCapture` returns for a stream with timeouts."""

    READ_S, OPEN_S = 1.0, 3.0

    def __init__(self, film: Film, source: object) -> None:
        self._film = film
        self._taken = 0
        if film.frozen:
            film.world.wait(lambda: not film.frozen, self.OPEN_S)
        self._up = str(source).startswith("http://camera") and not (film.dropped or film.frozen)
        film.opened += self._up

    def isOpened(self) -> bool:
        return self._up

    def get(self, what: int) -> float:
        return 0.0

    def grab(self) -> bool:
        film = self._film
        film.world.wait(lambda: film.dropped, 1.0 / film.rate)
        if film.frozen and not film.dropped:
            film.world.wait(lambda: not film.frozen or film.dropped, self.READ_S)
        return not (film.dropped or film.frozen)

    def retrieve(self) -> tuple[bool, NDArray[np.uint8]]:
        self._taken += 1
        width, height = self._film.size
        chance = np.random.default_rng(self._taken)
        if self._film.scene is None:
            return True, chance.integers(0, 255, (height, width, 3), dtype=np.uint8)
        noisy = self._film.scene + chance.normal(0.0, 2.0, self._film.scene.shape)
        grey = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        return True, np.repeat(grey[:, :, None], 3, axis=2)

    def release(self) -> None:
        self._film.released += self._up
        self._up = False


@dataclass
class Site:
    """Robots and a camera on simulated time."""

    world: VirtualTime
    film: Film
    ports: Ports
    robots: list[Emulator] = field(default_factory=list)

    def robot(
        self,
        url: str = "/dev/robot",
        subclass: str = "p3dx-sh",
        personality: Personality = ARCOS,
        seed: int = 0,
        surroundings: World | None = None,
        *,
        notices_hang_up: bool = False,
    ) -> Emulator:
        """Switch a robot on; its port is in ``url``."""
        line = self.ports.lines[url] = Line(self.world, url)
        firmware = Firmware(profile(emulated(subclass), personality), world=surroundings)
        emulator = Emulator(firmware, line.port(), seed=seed, notices_hang_up=notices_hang_up)
        emulator.__enter__()
        self.robots.append(emulator)
        return emulator

    def line(self, robot: Emulator) -> Line:
        return self.ports.lines[robot.url]

    def meanwhile(self, act: Callable[[], object]) -> None:
        """Do something in a thread of its own."""
        self.world.start(act, "test")

    def wait_until(self, done: Callable[[], bool], limit: float = 10.0) -> float:
        """Let time pass until something is so; return how long it took (s)."""
        began = self.world.now
        while not done():
            assert self.world.now < began + limit, "it never happened"
            self.world.sleep(0.002)
        return self.world.now - began

    def at_speed(self, robot: Emulator, velocity: Velocity) -> None:
        """Let time pass until the robot drives that fast."""
        self.wait_until(lambda: abs(robot.velocity.v - velocity.v) < 1e-9)


def make_site(monkeypatch: pytest.MonkeyPatch, world: VirtualTime) -> Site:
    """Return an empty site whose ports and camera are those that programs find."""
    assert threading.current_thread() is threading.main_thread()
    keep_time(world, monkeypatch)
    site = Site(world, Film(world), Ports())
    monkeypatch.setattr(serial, "serial_for_url", site.ports.serial_for_url)
    monkeypatch.setattr(cv2, "VideoCapture", site.film.capture)
    return site


def renamed_robot(folder: Path, subclass: str) -> Path:
    """Write the file of a P3-DX whose controller calls itself otherwise; return its path."""
    source = resources.files("visctrl.robots") / "p3dx" / "robot.yaml"
    data = yaml.safe_load(source.read_text(encoding="utf-8"))
    data["name"] = f"{subclass}-robot"
    data["arcos"]["subclasses"] = {subclass: {"distance_mm": 1.0}}
    path = folder / "robot.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path
