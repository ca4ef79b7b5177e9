"""Which renderer draws: the one asked for, or the fastest that works here."""

from __future__ import annotations

import statistics
import sys
import time
from functools import cache
from typing import Literal

import numpy as np

from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.errors import InputError
from visctrl.hal.types import Pose
from visctrl.sim.options import RendererName
from visctrl.sim.render.gl_context import gl_problem
from visctrl.sim.render.probe import answer
from visctrl.sim.render.renderer import BulletRenderer, Renderer
from visctrl.sim.world.engine import egl_works, engine_problem, hands_over_arrays
from visctrl.sim.world.scene import Finish, Item, Room, Scene

DrawerName = Literal["tiny", "egl", "gl"]

#: In the order in which equals are preferred.
DRAWERS: tuple[DrawerName, ...] = ("gl", "tiny", "egl")
_WARM_UP, _FRAMES = 1, 3
_EYE_M = 0.75
#: A picture that shows something varies at least by this much (grey levels).
_LEAST_SPREAD = 10.0


def open_renderer(
    wanted: RendererName | None,
    scene: Scene,
    camera: CentralCamera,
    detail: float = 1.0,
    floor: bool = True,
) -> Renderer:
    """Return a renderer of a scene, after trying out in another process whether it works.

    Parameters
    ----------
    wanted : {"auto", "tiny", "egl", "gl"} or None
        See `visctrl.sim.options.SimOptions`.
    scene, camera, detail, floor
        See `BulletRenderer` and `GlRenderer`.

    Raises
    ------
    InputError
        What is wanted does not work here.
    """
    return _open(choose_drawer(wanted), scene, camera, detail, floor)


def choose_drawer(wanted: RendererName | None) -> DrawerName:
    """Return what draws where ``wanted`` is asked for.

    What is not asked for by name is told on standard error: the result of ``auto``, and another
    default than ``tiny``.

    Raises
    ------
    InputError
        What is wanted does not work here.
    """
    if wanted is None:
        name, why = _default()
        if why:
            print(f"renderer: {name}, {why}", file=sys.stderr)
        wanted = name
    if wanted == "auto":
        name, why = _fastest()
        print(f"renderer: {name}, {why}", file=sys.stderr)
        return name
    if problem := drawer_problem(wanted):
        raise InputError(f"renderer '{wanted}': {problem}")
    return wanted


def drawer_problem(name: DrawerName) -> str:
    """Return why a renderer cannot be used here and what to do, "" if it can."""
    if name == "gl":
        return gl_problem()
    if problem := engine_problem():
        return problem
    if name == "egl" and not egl_works():
        return (
            "PyBullet's EGL plugin does not draw here: install an EGL driver (on Debian: libegl1 "
            "libgl1-mesa-dri), or use renderer 'tiny'"
        )
    return ""


@cache
def _default() -> tuple[DrawerName, str]:
    """Return what draws where nothing is asked for, and why if it is not what it always is."""
    if hands_over_arrays():
        return "tiny", ""
    why = engine_problem() or "PyBullet was built without NumPy here and gives pixels one by one"
    if problem := gl_problem():
        return "tiny", f"slowly: {why}; and renderer 'gl': {problem}"
    return "gl", f"because {why}"


@cache
def _fastest() -> tuple[DrawerName, str]:
    """Return the renderer that draws a typical frame fastest here, and how fast each one is.

    Each is tried once, in a process of its own.
    """
    times: dict[DrawerName, float] = {}
    for name in DRAWERS:
        code = f"from {__name__} import time_frame\ntime_frame({name!r})"
        said = answer(code)
        if said is not None:
            times[name] = float(said)
    # Without any answer (no other process can be started), the one that works everywhere.
    best: DrawerName = min(times, key=times.__getitem__) if times else "tiny"
    parts = [
        f"{name} {times[name]:.0f} ms" if name in times else f"{name} does not draw"
        for name in DRAWERS
    ]
    return best, f"the fastest here ({', '.join(parts)} a frame)"


def time_frame(name: DrawerName) -> None:
    """Draw a typical frame and print what it takes (ms), as an answer to `probe`.

    Prints nothing if the picture shows nothing.
    """
    camera = load_camera("hypercatadioptric")
    renderer = _open(name, _room(), camera)
    times = []
    for k in range(_WARM_UP + _FRAMES):
        began = time.perf_counter()
        image = renderer.render(Pose(0.05 * k, -0.5, 0.1 * k), _EYE_M)
        times.append(1e3 * (time.perf_counter() - began))
    renderer.close()
    if np.std(image[image > 0]) > _LEAST_SPREAD:
        print(f"\nanswer: {statistics.median(times[_WARM_UP:])}", flush=True)


def _open(
    name: DrawerName,
    scene: Scene,
    camera: CentralCamera,
    detail: float = 1.0,
    floor: bool = True,
) -> Renderer:
    if name == "gl":
        from visctrl.sim.render.gl_renderer import GlRenderer

        return GlRenderer(scene, camera, detail, floor)
    return BulletRenderer(scene, camera, name, detail, floor)


def _room() -> Scene:
    """Return a room with as many surfaces as a furnished one, without textures to prepare."""
    plain = Finish(pattern="plain")
    places = np.linspace(-np.pi, np.pi, 20, endpoint=False)
    boxes = [
        Item(
            name=f"box {k}",
            at_m=(3.0 * np.sin(angle), 3.0 * np.cos(angle)),
            size_m=(0.5, 0.4, 0.6 + 0.05 * k),
            yaw_deg=20.0 * k,
            pattern="plain",
            shade=0.2 + 0.03 * k,
        )
        for k, angle in enumerate(places)
    ]
    room = Room(x_m=(-5.0, 5.0), y_m=(-7.5, 7.5), height_m=2.6, walls=plain)
    return Scene(name="probe", room=room, items=tuple(boxes))
