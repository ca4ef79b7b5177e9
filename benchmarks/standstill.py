"""How soon a driving robot stands, and how far it gets, whatever happens to the program.

    python benchmarks/standstill.py                  # all cases, a table
    python benchmarks/standstill.py --only signal,disk   # those whose name begins so

The whole program drives the emulated Pioneer at 0.4 m/s over a pseudo-terminal, on the wall clock;
a film of noise is its camera, and plugins that look at nothing are its scheme. Then something
happens, and the emulator, a process of its own, tells when the wheels came to rest.
"""

from __future__ import annotations

import argparse
import ctypes
import fcntl
import io
import json
import math
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import termios
import time
import urllib.request
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np

from visctrl.contracts import (
    Controller,
    Decision,
    Estimate,
    Estimator,
    Health,
    Match,
    Perception,
    Views,
)
from visctrl.hal.cameras.models.unified import UnifiedCamera
from visctrl.hal.emulator.emulator import Emulator
from visctrl.hal.emulator.firmware import Firmware
from visctrl.hal.emulator.firmware_profile import PERSONALITIES, emulated, profile
from visctrl.hal.emulator.ports import PtyPort
from visctrl.hal.types import Frame, Velocity
from visctrl.robots.documents import StrictModel
from visctrl.runtime.target_view import TargetView

SPEED = 0.4
#: What is promised (s): where the program can act, and where only the robot's watchdog can.
PROGRAM_S, WATCHDOG_S = 0.6, 2.1
_MODEL = UnifiedCamera(
    name="small", width=160, height=120, xi=0.0, fx=100.0, fy=100.0, cx=79.5, cy=59.5
)
_SCENARIO = f"""
backend: pioneer
camera: {{name: small.yaml}}
perception: {{name: "standstill:Blind"}}
estimator: {{name: "standstill:Nothing"}}
controller: {{name: "standstill:Straight"}}
approach: {{enabled: false}}
safety: {{acceleration_m_s2: 1.0, v_m_s: {SPEED}}}
target: {{file: target.npz}}
"""
_WEB = "127.0.0.1:18050"


class NoOptions(StrictModel):
    """Nothing to choose."""


class Blind(Perception[NoOptions]):
    """Takes any image and reports the same twenty features."""

    Options: ClassVar[type[NoOptions]] = NoOptions

    def set_target(self, frames: Sequence[Frame]) -> None:
        """Take it."""

    def set_initial(self, frame: Frame) -> Match:
        """Take it."""
        return Match(20, 20, np.zeros((20, 2)), np.zeros((20, 2)))

    def update(self, frame: Frame) -> Views:
        """Report the features."""
        rays = np.tile([0.0, 1.0, 0.0], (20, 1))
        return Views(np.arange(20), rays, rays, rays, np.zeros((20, 2)), 0.001, frame.stamp)


class Nothing(Estimator[NoOptions, Estimate]):
    """Estimates nothing."""

    Options: ClassVar[type[NoOptions]] = NoOptions

    def reset(self) -> None:
        """Forget nothing."""

    def update(self, views: Views, sent: Velocity, dt: float) -> Estimate:
        """Say that all is well."""
        return Estimate(Health.OK)


class Straight(Controller[NoOptions, Estimate]):
    """Drives ahead, until a file tells it to misbehave."""

    Options: ClassVar[type[NoOptions]] = NoOptions
    accepts = Estimate

    def update(self, estimate: Estimate, sent: Velocity, dt: float) -> Decision:
        """Drive."""
        if os.path.exists("sleep"):
            time.sleep(60.0)
        if os.path.exists("hold"):
            ctypes.PyDLL(None).sleep(60)  # without giving the interpreter's lock away
        if os.path.exists("regex"):
            re.match(r"(a+)+$", "a" * 60 + "b")  # likewise, for ages
        if os.path.exists("raise"):
            raise ZeroDivisionError("as told")
        if os.path.exists("nan"):
            return Decision(Velocity(math.nan, 0.0), "drive")
        return Decision(Velocity(SPEED, 0.0), "drive")


@dataclass
class Scene:
    """A program under way: its process, the robot, its folder, and its terminal's other end."""

    process: subprocess.Popen[bytes]
    robot: Emulator
    folder: Path
    terminal: io.FileIO

    def close_terminal(self) -> None:
        """Close the window that the program runs in."""
        self.terminal.close()

    def signal(self, number: int) -> None:
        """Send a signal."""
        self.process.send_signal(number)

    def tell(self, name: str) -> None:
        """Have the controller misbehave."""
        (self.folder / name).touch()

    def fill_disk(self) -> None:
        """Let no file of the program grow any more."""
        size = (self.folder / "o" / "ticks.csv").stat().st_size
        resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, (size, size))

    def close_pipes(self) -> None:
        """Close what reads the program's output."""
        for pipe in (self.process.stdout, self.process.stderr):
            assert pipe is not None
            pipe.close()

    def press_stop(self) -> None:
        """Press STOP on the page."""
        page = urllib.request.Request(f"http://{_WEB}/stop", method="POST")
        urllib.request.urlopen(page, timeout=5.0).read()


@dataclass(frozen=True)
class Case:
    """Something that happens, and how soon the robot must stand (None: it goes on)."""

    name: str
    happen: Callable[[Scene], object]
    limit_s: float | None = PROGRAM_S


def _fault(kind: str) -> Callable[[Scene], object]:
    return lambda scene: scene.robot.faults.switch_on(kind)


CASES = (
    Case("signal INT", lambda scene: scene.signal(signal.SIGINT)),
    Case("signal TERM", lambda scene: scene.signal(signal.SIGTERM)),
    Case("signal HUP", lambda scene: scene.signal(signal.SIGHUP)),
    Case("signal QUIT", lambda scene: scene.signal(signal.SIGQUIT)),
    Case("signal TSTP", lambda scene: scene.signal(signal.SIGTSTP)),
    Case("signal STOP", lambda scene: scene.signal(signal.SIGSTOP)),
    Case("signal KILL", lambda scene: scene.signal(signal.SIGKILL)),
    Case("terminal closed", Scene.close_terminal),
    Case("STOP on the page", Scene.press_stop),
    Case("output closed", Scene.close_pipes, None),
    Case("disk full", Scene.fill_disk),
    Case("plugin raises", lambda scene: scene.tell("raise")),
    Case("plugin asks for NaN", lambda scene: scene.tell("nan")),
    Case("plugin sleeps", lambda scene: scene.tell("sleep")),
    Case("plugin holds the lock", lambda scene: scene.tell("hold")),
    Case("plugin backtracks", lambda scene: scene.tell("regex")),
    Case("robot silent", _fault("silent")),
    Case("robot deaf", _fault("deaf"), WATCHDOG_S),
    Case("robot reset", _fault("reset")),
    Case("wheel stalled", _fault("stall")),
    Case("bumper", _fault("bumper")),
    Case("emergency stop", _fault("estop")),
    Case("battery low", _fault("low-battery")),
)


@dataclass(frozen=True)
class Result:
    """What came of a case: time (s) and way (m) to standstill, exit code, the run's reason."""

    took: float
    way: float
    code: int | None
    said: str


def measure(case: Case, folder: Path) -> Result:
    """Drive, let it happen, and watch until the wheels rest."""
    for name in ("sleep", "hold", "regex", "raise", "nan"):
        (folder / name).unlink(missing_ok=True)
    subclass = emulated("p3dx-sh")
    firmware = Firmware(profile(subclass, PERSONALITIES["arcos"]))
    window, terminal = os.openpty()
    with (
        io.FileIO(window, "r+") as far_end,
        Emulator(firmware, PtyPort()) as robot,
        _program(robot.url, folder, terminal) as process,
    ):
        os.close(terminal)
        scene = Scene(process, robot, folder, far_end)
        try:
            _wait(lambda: robot.velocity.v > SPEED - 0.01, 30.0, process)
            time.sleep(0.37)
            began, where = robot.now(), robot.pose
            case.happen(scene)
            still = _rest(robot, 1.5 if case.limit_s is None else 10.0)
            took = math.inf if still is None else still - began
            way = math.dist(where[:2], robot.pose[:2])
        finally:
            process.send_signal(signal.SIGCONT)
            if process.poll() is None and (case.limit_s is None or took > 5.0):
                process.send_signal(signal.SIGINT)
        return Result(took, way, _ended(process), _reason(folder))


def _program(url: str, folder: Path, terminal: int) -> subprocess.Popen[bytes]:
    here = Path(__file__).resolve().parent
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (here, here.parent)))}
    arguments = ["run", "scenario.yaml", "--port", url, "--camera-url", "film.avi", "--out", "o"]
    return subprocess.Popen(
        [sys.executable, "-m", "visctrl", *arguments, "--overwrite", "--web-address", _WEB],
        cwd=folder,
        env=environment,
        stdin=terminal,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def _ended(process: subprocess.Popen[bytes]) -> int | None:
    """Return the exit code; None for a program that had to be killed."""
    try:
        if process.stderr is not None and not process.stderr.closed:
            process.communicate(timeout=15.0)
        return process.wait(timeout=15.0)
    except subprocess.TimeoutExpired:
        process.kill()
        return None


def _reason(folder: Path) -> str:
    """Return how the run says that it ended; empty where it left no summary."""
    summary = folder / "o" / "summary.json"
    return str(json.loads(summary.read_text())["reason"]) if summary.exists() else ""


def _rest(robot: Emulator, patience_s: float) -> float | None:
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        if robot.standing_since is not None:
            return robot.standing_since
        time.sleep(0.005)
    return None


def _wait(until: Callable[[], bool], patience_s: float, process: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + patience_s
    while not until():
        if time.monotonic() > end or process.poll() is not None:
            process.kill()
            raise RuntimeError(f"the robot does not drive: {process.communicate()[1].decode()}")
        time.sleep(0.01)


def _prepare(folder: Path) -> None:
    (folder / "scenario.yaml").write_text(_SCENARIO)
    (folder / "small.yaml").write_text(_MODEL.model_dump_json())
    TargetView(np.zeros((1, 120, 160), np.uint8), _MODEL).save(folder / "target.npz")
    rng = np.random.default_rng(0)
    film = cv2.VideoWriter(
        str(folder / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (160, 120)
    )
    for _ in range(1200):
        film.write(rng.integers(0, 255, (120, 160, 3), dtype=np.uint8))
    film.release()


def main() -> int:
    """Measure the cases, print a row each; return 1 if one is beyond its limit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="cases whose name begins so")
    parser.add_argument("--json", action="store_true", help="one JSON object a case")
    options = parser.parse_args()
    wrong = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _prepare(folder)
        for case in CASES:
            if not case.name.startswith(tuple(options.only.split(","))):
                continue
            found = measure(case, folder)
            good = case.limit_s is None or found.took <= case.limit_s
            wrong += not good
            if options.json:
                print(json.dumps({"case": case.name, **vars(found)}), flush=True)
                continue
            stood = "drives on" if math.isinf(found.took) else f"{found.took:5.2f} s"
            print(
                f"{case.name:<22} {stood:>9}  {100 * found.way:5.1f} cm  exit {found.code}  "
                f"{'' if good else 'TOO LATE  '}{found.said[:90]}",
                flush=True,
            )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
