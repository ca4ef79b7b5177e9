"""``visctrl doctor``: what works here, and what to do about what does not."""

from __future__ import annotations

import importlib
import os
import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.clock import WallClock
from visctrl.hal.types import Pose
from visctrl.robots import Robot, load_robot
from visctrl.robots.errors import VisctrlError
from visctrl.runtime.config import CameraChoice, Override, load_scenario
from visctrl.runtime.interrupts import Interrupts
from visctrl.runtime.plan import chosen_camera, make_plan
from visctrl.runtime.registry import REGISTRIES

if TYPE_CHECKING:
    from visctrl.hal.pioneer.base import PioneerBase
    from visctrl.sim.options import RendererName

_PACKAGES = (
    "numpy", "scipy", "opencv-python-headless", "filterpy", "pyyaml", "pyserial",
    "pydantic", "typer", "rich", "matplotlib",
)  # fmt: skip
#: PyBullet, and the fork that has ready-made files for newer Pythons.
_PHYSICS = ("pybullet", "pybullet-arm64")
_FAILED = 3
_RATE_HZ = 10.0
_TIMER_S, _TIMER_PERIOD_S = 1.0, 0.01
_LATE_MS = 10.0
_FILM_S = 2.0
_FRAMES, _WARM_UP = 18, 3
_PICTURES, _CAMERA_HEIGHT_M = 6, 0.4


class Level(StrEnum):
    """How a check came out."""

    OK = "ok"
    WARNING = "warning"
    FAILURE = "failure"


@dataclass(frozen=True)
class Finding:
    """A line of the report.

    what : the thing examined. found : the result. remedy : what to do, empty if nothing.
    """

    level: Level
    what: str
    found: str
    remedy: str = ""


def examine(
    port: str | None, source: str | None, camera: CameraChoice, expected: str, *, quick: bool
) -> int:
    """Check everything, print a line each, return the exit code (3 if something fails).

    Raises
    ------
    InputError
        There is no such camera or robot (``expected``) to compare with.
    """
    chosen_camera(camera)
    its = load_robot(expected)
    console = Console()
    checks: list[tuple[str, Callable[[], Iterator[Finding]]]] = [
        ("packages", packages),
        ("physics", physics),
        ("timer", timer),
        ("serial ports", serial_ports),
    ]
    if port is not None:
        checks.append((f"robot {port}", lambda: robot(port, its)))
    if source is not None:
        checks.append((f"camera {source}", lambda: camera_stream(source, camera)))
    if not quick:
        checks += [
            ("renderers", lambda: renderers(camera)),
            ("tick budget", lambda: tick_budget(camera)),
        ]
    worst = Level.OK
    with Interrupts():
        for what, check in checks:
            for finding in _guarded(what, check):
                _print(console, finding)
                worst = max(worst, finding.level, key=list(Level).index)
    return _FAILED if worst is Level.FAILURE else 0


def packages() -> Iterator[Finding]:
    """Check Python and the packages that this program needs."""
    yield Finding(Level.OK, "python", platform.python_version())
    found, missing = [], []
    for package in _PACKAGES:
        if _installed(package):
            found.append(f"{package} {version(package)}")
        else:
            missing.append(package)
    yield Finding(Level.OK, "packages", ", ".join(found))
    if missing:
        names = " ".join(missing)
        yield Finding(Level.FAILURE, "packages", f"missing: {names}", f"pip install {names}")


def physics() -> Iterator[Finding]:
    """Check the engine of the simulation, which no other backend needs."""
    from visctrl.sim.world.engine import engine_problem, hands_over_arrays

    if problem := engine_problem():
        yield Finding(Level.WARNING, "physics", "no PyBullet", problem)
        return
    named = [f"{name} {version(name)}" for name in _PHYSICS if _installed(name)]
    slow = not hands_over_arrays()
    yield Finding(
        Level.OK,
        "physics",
        " ".join(named) + (", built without NumPy" if slow else ""),
        "pictures by PyBullet are slow: the simulation draws with 'gl' if it works" if slow else "",
    )


def _installed(package: str) -> bool:
    try:
        return bool(version(package))
    except PackageNotFoundError:
        return False


def timer() -> Iterator[Finding]:
    """Check how late this process wakes up."""
    clock = WallClock()
    lateness = []
    due = clock.now()
    while due < _TIMER_S:
        due += _TIMER_PERIOD_S
        clock.sleep_until(due)
        lateness.append((clock.now() - due) * 1e3)
    worst = sorted(lateness)[int(0.99 * len(lateness))]
    load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    good = worst <= _LATE_MS
    yield Finding(
        Level.OK if good else Level.WARNING,
        "timer",
        f"wakes up {worst:.1f} ms late (p99), {load}",
        "" if good else "close other programs: ticks will be late",
    )


def serial_ports() -> Iterator[Finding]:
    """List the serial ports, and whether this user may open them."""
    list_ports = importlib.import_module("serial.tools.list_ports")
    ports = sorted(list_ports.comports(), key=lambda port: str(port.device))
    if not ports:
        yield Finding(Level.OK, "serial ports", "none (a pty or socket needs none)")
    for port in ports:
        allowed = os.access(port.device, os.R_OK | os.W_OK) or os.name == "nt"
        yield Finding(
            Level.OK if allowed else Level.WARNING,
            "serial port",
            f"{port.device}: {port.description}",
            "" if allowed else "not permitted: join the group that owns it (often 'dialout')",
        )


def robot(port: str, its: Robot) -> Iterator[Finding]:
    """Ask the robot who it is and how it is set; it does not move.

    ``its`` is the robot whose file is looked at first for the units of what answers.
    """
    from visctrl.hal.pioneer.base import PioneerBase

    base = PioneerBase(port, its, its.operating, WallClock())
    status = base.inspect()
    identity, config = base.identity, base.config
    if identity is not None:
        name = f"{identity.robot_type} {identity.subclass} '{identity.name}'"
        yield Finding(Level.OK, f"robot {port}", name)
    if config is None:
        yield Finding(
            Level.WARNING, "firmware", "does not tell its parameters", "its limits are unknown"
        )
    else:
        yield Finding(
            Level.OK,
            "firmware",
            f"version {config.firmware}, report every {config.report_cycle} ms, watchdog "
            f"{config.watchdog} ms, at most {config.speed_max} mm/s and {config.turn_max} deg/s",
        )
        if not config.watchdog:
            yield Finding(
                Level.FAILURE, "watchdog", "off", "set the parameter Watchdog to 2000 ms: it is "
                "what stops the robot when this computer fails",
            )  # fmt: skip
    yield from _line(base)
    low = any("battery" in fault for fault in status.faults)
    if status.battery_v is not None:
        yield Finding(
            Level.FAILURE if low else Level.OK,
            "battery",
            f"{status.battery_v:.1f} V",
            "charge it" if low else "",
        )
    for fault in status.faults:
        if "battery" not in fault:
            yield Finding(Level.FAILURE, "robot", fault, "release it before driving")


def _line(base: PioneerBase) -> Iterator[Finding]:
    """Say how quickly the robot answers, and what the reports take of a serial line."""
    from visctrl.hal.pioneer.timing import SLOW_S

    took = f"answers in {base.round_trip_s:.2f} s"
    load = base.line_load
    heavy, slow = load is not None and load.heavy, base.round_trip_s > SLOW_S
    yield Finding(
        Level.WARNING if heavy or slow else Level.OK,
        "line",
        took if load is None else f"{took}; {load}",
        "slow: what the robot is told and what it tells comes late" if slow else "",
    )


def camera_stream(source: str, choice: CameraChoice) -> Iterator[Finding]:
    """Measure the camera's rate and the age of its pictures."""
    from visctrl.hal.cameras.capture import CaptureCamera, CaptureOptions

    clock = WallClock()
    model = chosen_camera(choice)
    camera = CaptureCamera(model, CaptureOptions(source=source, max_age_s=_FILM_S), clock)
    try:
        camera.open()
        first = camera.read()
        begin, ages = clock.now(), []
        while clock.now() < begin + _FILM_S:
            frame = camera.read()
            ages.append(clock.now() - frame.stamp)
            clock.sleep_until(clock.now() + 0.01)
    finally:
        camera.close()
    rate = (frame.sequence - first.sequence) / (frame.stamp - first.stamp or float("inf"))
    good = rate >= 0.9 * _RATE_HZ
    yield Finding(
        Level.OK if good else Level.WARNING,
        f"camera {source}",
        f"{model.width}x{model.height}, {rate:.1f} pictures/s, the newest at most "
        f"{max(ages):.2f} s old",
        "" if good else "more light, a shorter exposure or a smaller picture makes it faster",
    )


def renderers(camera: CameraChoice) -> Iterator[Finding]:
    """Check the simulator's renderers, and how fast they draw."""
    from visctrl.sim.render.renderer_choice import DRAWERS, drawer_problem

    model = chosen_camera(camera)
    for drawer in DRAWERS:
        if problem := drawer_problem(drawer):
            # Not a fault: the default one works everywhere.
            yield Finding(Level.OK, f"renderer {drawer}", "does not work here", problem)
            continue
        took = _median(list(_drawing_times(drawer, model)))
        found = f"{took:.0f} ms a picture of {model.width}x{model.height}"
        yield Finding(Level.OK, f"renderer {drawer}", found)


def _drawing_times(drawer: RendererName, model: CentralCamera) -> Iterator[float]:
    """Yield what single pictures take (ms)."""
    from visctrl.sim.render.renderer_choice import open_renderer
    from visctrl.sim.world.scene import load_scene

    renderer = open_renderer(drawer, load_scene("hall"), model)
    try:
        for k in range(_PICTURES):
            begin = time.perf_counter()
            renderer.render(Pose(0.1 * k, -1.0, 0.1 * k), _CAMERA_HEIGHT_M)
            if k:  # the first one also loads things
                yield (time.perf_counter() - begin) * 1e3
    finally:
        renderer.close()


def tick_budget(camera: CameraChoice) -> Iterator[Finding]:
    """Measure perception and estimation on this machine, in a simulated run."""
    overrides = [
        Override(("backend",), "sim", "doctor"),
        *(
            Override(("camera", name), value, "doctor")
            for name, value in camera.model_dump(exclude_unset=True).items()
        ),
    ]
    plan = make_plan(load_scenario("default", overrides, REGISTRIES.backends.names()))
    worked = []
    with plan.open_backend() as backend:
        context = plan.context(backend.clock.lockstep)
        perception = plan.perception.build(context)
        estimator = plan.main.estimator.build(context)
        try:
            perception.set_target(backend.teach(1))
            perception.set_initial(backend.camera.read())
            estimator.reset()
            for _ in range(_FRAMES):
                backend.clock.sleep_until(backend.clock.now() + plan.period_s)
                frame = backend.camera.read()
                seen = time.perf_counter()
                sent = backend.base.command(backend.base.odometry().velocity)
                estimator.update(perception.update(frame), sent, plan.period_s)
                worked.append((time.perf_counter() - seen) * 1e3)
        finally:
            estimator.close()
            perception.close()
    worked = worked[_WARM_UP:]
    share = max(worked) / (plan.period_s * 1e3)
    level = Level.OK if share < 0.5 else Level.WARNING if share < 1.0 else Level.FAILURE
    yield Finding(
        level,
        "tick budget",
        f"perception and estimation take {_median(worked):.0f} ms, at most {max(worked):.0f} ms, "
        f"of {plan.period_s * 1e3:.0f} ms",
        "" if level is Level.OK else "use a smaller picture: --set camera.width=400",
    )


def _guarded(what: str, check: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    """Run a check; whatever it fails with is a finding like others."""
    try:
        yield from check()
    except VisctrlError as error:
        yield Finding(Level.FAILURE, what, str(error))
    except ImportError as error:
        yield Finding(Level.FAILURE, what, str(error), "install the missing package (see packages)")
    except Exception as error:
        yield Finding(Level.FAILURE, what, f"{type(error).__name__}: {error}")


def _median(values: list[float]) -> float:
    return sorted(values)[len(values) // 2]


def _print(console: Console, finding: Finding) -> None:
    colour = {Level.OK: "green", Level.WARNING: "yellow", Level.FAILURE: "red"}[finding.level]
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(width=8)
    table.add_column(width=14, overflow="fold")
    table.add_column(overflow="fold")
    text = escape(finding.found) + (f" -> {escape(finding.remedy)}" if finding.remedy else "")
    table.add_row(f"[{colour}]{finding.level}[/{colour}]", escape(finding.what), text)
    console.print(table)
