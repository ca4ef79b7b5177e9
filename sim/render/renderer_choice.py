"""Which renderer draws: the one asked for, if it works here, or the usual one."""

from __future__ import annotations

import sys
from functools import cache

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.errors import InputError
from visctrl.sim.options import RendererName
from visctrl.sim.render.gl_context import gl_problem
from visctrl.sim.render.renderer import BulletRenderer, Renderer
from visctrl.sim.world.engine import engine_problem, hands_over_arrays
from visctrl.sim.world.scene import Scene

#: In the order in which ``visctrl doctor`` names them.
DRAWERS: tuple[RendererName, ...] = ("gl", "tiny")


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
    wanted : {"tiny", "gl"} or None
        See `visctrl.sim.options.SimOptions`.
    scene, camera, detail, floor
        See `BulletRenderer` and `GlRenderer`.

    Raises
    ------
    InputError
        What is wanted does not work here.
    """
    if choose_drawer(wanted) == "gl":
        from visctrl.sim.render.gl_renderer import GlRenderer

        return GlRenderer(scene, camera, detail, floor)
    return BulletRenderer(scene, camera, detail, floor)


def choose_drawer(wanted: RendererName | None) -> RendererName:
    """Return what draws where ``wanted`` is asked for.

    Another default than ``tiny`` is told on standard error.

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
    if problem := drawer_problem(wanted):
        raise InputError(f"renderer '{wanted}': {problem}")
    return wanted


def drawer_problem(name: RendererName) -> str:
    """Return why a renderer cannot be used here and what to do, "" if it can."""
    return gl_problem() if name == "gl" else engine_problem()


@cache
def _default() -> tuple[RendererName, str]:
    """Return what draws where nothing is asked for, and why if it is not what it always is."""
    if hands_over_arrays():
        return "tiny", ""
    why = engine_problem() or "PyBullet was built without NumPy here and gives pixels one by one"
    if problem := gl_problem():
        return "tiny", f"slowly: {why}; and renderer 'gl': {problem}"
    return "gl", f"because {why}"
