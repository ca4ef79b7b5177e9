"""``visctrl emulate-pioneer``: a robot at the end of a line, with a camera on it."""

from __future__ import annotations

import json
import math
import re
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.emulator.emulator import Emulator
from visctrl.hal.emulator.faults import FaultSchedule, parse_fault
from visctrl.hal.emulator.firmware import Firmware
from visctrl.hal.emulator.firmware_profile import PERSONALITIES, emulated, profile
from visctrl.hal.emulator.ports import Port, PtyPort, TcpPort
from visctrl.hal.emulator.traffic import Traffic
from visctrl.hal.errors import CameraError, LinkError
from visctrl.hal.types import Pose, Velocity
from visctrl.robots.documents import suggestion
from visctrl.robots.errors import InputError
from visctrl.robots.model import Mount
from visctrl.robots.unicycle import step_exact
from visctrl.runtime.config import CameraChoice
from visctrl.runtime.interrupts import Interrupted, Interrupts
from visctrl.runtime.plan import chosen_camera
from visctrl.sim.emulated_camera import CameraSpec, EmulatedCamera, State
from visctrl.sim.world.scene import load_scene
from visctrl.sim.world.scene_world import SceneWorld

_CHECK_S = 0.2
_DEFAULT_TCP = 8101
_LAST_TCP = 65_535
_MAX_FPS = 200.0
_PORT = re.compile(r"(pty|socket)(?::(\d+))?")


@dataclass(frozen=True)
class Emulation:
    """What to emulate.

    port : ``pty``, ``socket`` or ``socket:PORT``. robot : subclass, or a robot's name or path.
    start : pose of the camera in the scene. camera : None for a robot without one. faults : as
    `parse_fault` reads them. slip : fractions of v and ω that the odometry does not notice.
    hang_up : who stops the robot when a TCP client hangs up, ``watchdog`` or ``stop``. log : file
    of what is received, and of where the robot truly is.
    """

    port: str
    robot: str
    personality: str
    start: Pose
    scene: str
    camera: CentralCamera | None
    mount: str
    fps: float
    stream_port: int
    faults: Sequence[str]
    slip: tuple[float, float]
    seed: int
    hang_up: str
    log: Path | None


def camera_model(name: str, width: int | None) -> CentralCamera | None:
    """Return a camera by name or calibration file, in the wanted size; None for ``none``."""
    if name == "none":
        return None
    return chosen_camera(CameraChoice(name=name, width=width))


def start_pose(start: tuple[float, float, float]) -> Pose:
    """Return a start given in metres and degrees."""
    x, y, phi = start
    if not all(map(math.isfinite, start)):
        raise InputError(f"--start {x:g} {y:g} {phi:g}: expected three numbers")
    return Pose(x, y, math.radians(phi))


def emulate(wanted: Emulation) -> int:
    """Emulate until Ctrl-C or SIGTERM; print the port and the stream's URL, a line each.

    Raises
    ------
    InputError, DeviceError
        It cannot be set up, or a part of it fails.
    """
    _check(wanted)
    schedule = FaultSchedule(parse_fault(text) for text in wanted.faults)
    subclass = emulated(wanted.robot)
    personality = PERSONALITIES[_known("personality", wanted.personality, PERSONALITIES)]
    its = profile(subclass, personality)
    robot = subclass.robot
    mount = robot.mount(wanted.mount)
    scene = load_scene(wanted.scene)
    scene.check_clear(wanted.start, mount.forward_m, robot, "start")
    axle = Pose(*step_exact(wanted.start, -mount.forward_m, 0.0, 1.0).tolist())
    make_port = _port(wanted.port)
    firmware = Firmware(its, axle, SceneWorld(scene, robot), Velocity(*wanted.slip))
    with Interrupts(suspendable=True) as interrupts, ExitStack() as stack:
        camera = None
        if wanted.camera is not None:
            camera = stack.enter_context(_camera(wanted, wanted.camera, mount, axle))
        traffic = Traffic(stack.enter_context(_log_file(wanted.log)))
        companion = None if camera is None else camera.move
        emulator = stack.enter_context(
            Emulator(
                firmware,
                make_port(),
                schedule,
                traffic,
                wanted.seed,
                notices_hang_up=wanted.hang_up == "stop",
                companion=companion,
            )
        )
        print(emulator.url, flush=True)
        if camera is not None:
            print(camera.url, flush=True)
        try:
            _run(emulator, camera)
        except Interrupted:
            interrupts.ignore()
        _report(emulator, mount)
    return 0


def _check(wanted: Emulation) -> None:
    _known("hang-up", wanted.hang_up, ("watchdog", "stop"))
    if not 0.0 < wanted.fps <= _MAX_FPS:
        raise InputError(f"--fps {wanted.fps:g}: at most {_MAX_FPS:g}, and more than 0")
    if not all(-1.0 < share < 1.0 for share in wanted.slip):
        v, omega = wanted.slip
        raise InputError(f"--slip {v:g} {omega:g}: expected shares between -1 and 1")


def _run(emulator: Emulator, camera: EmulatedCamera | None) -> None:
    """Pass faults on to the camera, until interrupted."""
    pause = threading.Event()
    state = State.WORKING
    while not pause.wait(_CHECK_S if camera is None else _CHECK_S / 10):
        if not emulator.running:
            raise LinkError(f"the emulator has failed: {emulator.failure!r}")
        if camera is None:
            continue
        if not camera.alive:
            raise CameraError("the emulated camera's process has died")
        frozen, dropped = ("camera-frozen" in emulator.faults, "camera-dropped" in emulator.faults)
        new = State.DROPPED if dropped else State.FROZEN if frozen else State.WORKING
        if new is not state:
            camera.become(new)
            state = new


def _report(emulator: Emulator, mount: Mount) -> None:
    """Say on stderr where the robot ended and whether its clients kept the rules."""
    x, y, phi = step_exact(emulator.pose, mount.forward_m, 0.0, 1.0).tolist()
    violations = emulator.traffic.violations()
    summary = {
        "camera": {"x_m": round(x, 5), "y_m": round(y, 5), "phi_deg": round(math.degrees(phi), 4)},
        "packets": len(emulator.traffic.entries),
        "violations": violations,
    }
    print(json.dumps(summary), file=sys.stderr)


def _camera(wanted: Emulation, model: CentralCamera, mount: Mount, axle: Pose) -> EmulatedCamera:
    spec = CameraSpec(
        scene=wanted.scene,
        camera=model,
        mount=mount,
        fps=wanted.fps,
        port=wanted.stream_port,
        seed=wanted.seed,
    )
    return EmulatedCamera(spec, axle)


def _port(text: str) -> Callable[[], Port]:
    """Return what opens the port that ``text`` names."""
    match = _PORT.fullmatch(text)
    if match is None or (match[1] == "pty" and match[2]):
        raise InputError(f"--port {text}: expected pty, socket or socket:PORT")
    if match[1] == "pty":
        return PtyPort
    number = _DEFAULT_TCP if match[2] is None else int(match[2])
    if number > _LAST_TCP:
        raise InputError(f"--port {text}: TCP ports end at {_LAST_TCP}")
    return lambda: TcpPort(number)


def _known(what: str, name: str, names: Iterable[str]) -> str:
    if name not in set(names):
        raise InputError(f"unknown {what} '{name}'; {suggestion(name, names)}")
    return name


@contextmanager
def _log_file(path: Path | None) -> Iterator[TextIO | None]:
    if path is None:
        yield None
        return
    try:
        file = path.open("w", encoding="utf-8")
    except OSError as error:
        raise InputError(f"--log {path}: {error.strerror}") from None
    with file:
        yield file
