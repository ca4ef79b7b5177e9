"""PyBullet, kept from talking on standard output and from ending the process.

It reports its build, its threads and its OpenGL context on the standard streams, below Python's
own; and where a display or an EGL driver is missing it calls ``exit``. So its chatter is sent
nowhere, and what may not work is tried in another process first.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

from visctrl.hal.errors import InputError
from visctrl.sim.render.probe import works

__all__ = [
    "connect",
    "connect_window",
    "disconnect",
    "egl_works",
    "engine_problem",
    "hands_over_arrays",
    "hushed",
    "load_egl",
    "pybullet",
]

_STREAMS = (1, 2)


@contextmanager
def hushed() -> Iterator[None]:
    """Discard what native code writes to the standard streams meanwhile."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(stream) for stream in _STREAMS]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for stream in _STREAMS:
            os.dup2(nowhere, stream)
        yield
    finally:
        _flush_native()
        for stream, copy in zip(_STREAMS, kept, strict=True):
            os.dup2(copy, stream)
            os.close(copy)
        os.close(nowhere)


def _flush_native() -> None:
    """Empty the C library's buffers, which would else be written after the hush."""
    if os.name == "posix":
        ctypes.CDLL(None).fflush(None)


#: Pythons for which a maintained fork of PyBullet has ready-made files, and its name.
_FORK, _FORK_PYTHONS = "pybullet-arm64", ((3, 12), (3, 13))
_LAST_WHEELS = (3, 11)


class _Absent:
    """Stands in for PyBullet where it is not installed; whoever uses it is told what to do."""

    def __getattr__(self, name: str) -> Any:
        raise InputError(engine_problem())


def engine_problem() -> str:
    """Return why there is no PyBullet and what to do; empty if there is."""
    if not isinstance(pybullet, _Absent):
        return ""
    python = sys.version_info[:2]
    if python in _FORK_PYTHONS:
        remedy = f"pip install {_FORK}"
    elif python <= _LAST_WHEELS:
        remedy = "pip install pybullet"
    else:
        remedy = (
            f"pip install pybullet (for Python {python[0]}.{python[1]} it must be compiled, which "
            "takes some minutes)"
        )
    return (
        f"the simulation needs PyBullet, which is not installed: {remedy}; the backends mock and "
        "pioneer do without"
    )


def hands_over_arrays() -> bool:
    """Return whether PyBullet was built with NumPy: else pictures come number by number.

    The fork for Python 3.12 and 3.13 was not: a picture of 800 by 600 then costs some 200 ms,
    which are 24 ms otherwise.
    """
    return not isinstance(pybullet, _Absent) and bool(pybullet.isNumpyEnabled())


try:
    with hushed():
        import pybullet
except ImportError:
    pybullet = _Absent()


def connect() -> int:
    """Return a new client without a window."""
    return int(pybullet.connect(pybullet.DIRECT))


def connect_window() -> int:
    """Return a new client with PyBullet's window.

    Raises
    ------
    InputError
        No window can be opened here.
    """
    if not works(_WINDOW_PROBE):
        raise InputError(
            "PyBullet's window cannot be opened (no display, or no OpenGL on it): run without --gui"
        )
    with hushed():
        return int(pybullet.connect(pybullet.GUI))


def egl_works() -> bool:
    """Return whether PyBullet's EGL renderer draws on this machine."""
    return find_spec(_EGL_MODULE) is not None and works(_EGL_PROBE)


def load_egl(client: int) -> int:
    """Load the EGL renderer into a client, after `egl_works`, and return the plugin's number."""
    spec = find_spec(_EGL_MODULE)
    assert spec is not None
    with hushed():
        plugin = int(pybullet.loadPlugin(spec.origin, _EGL_PLUGIN, physicsClientId=client))
        # The first two pictures report the driver's vendor.
        for _ in range(2):
            pybullet.getCameraImage(
                16, 16, renderer=pybullet.ER_BULLET_HARDWARE_OPENGL, physicsClientId=client
            )
    return plugin


def disconnect(client: int) -> None:
    """Close a client, and its window if it has one."""
    if pybullet.isConnected(client):
        with hushed():
            pybullet.disconnect(physicsClientId=client)


_EGL_MODULE = "eglRenderer"
_EGL_PLUGIN = "_eglRendererPlugin"

_WINDOW_PROBE = """
import pybullet
client = pybullet.connect(pybullet.GUI)
print("\\nanswer: works" if client >= 0 else "\\nanswer: fails", flush=True)
"""

#: Draws a red box and looks at a pixel of it and at one beside it.
_EGL_PROBE = f"""
import importlib.util
import pybullet as p
client = p.connect(p.DIRECT)
p.loadPlugin(importlib.util.find_spec("{_EGL_MODULE}").origin, "{_EGL_PLUGIN}")
shape = p.createVisualShape(p.GEOM_BOX, halfExtents=[0.5] * 3, rgbaColor=[1, 0, 0, 1])
p.createMultiBody(baseVisualShapeIndex=shape, basePosition=[3, 0, 0])
view = p.computeViewMatrix([0, 0, 0], [1, 0, 0], [0, 0, 1])
lens = p.computeProjectionMatrixFOV(60, 1, 0.1, 10)
picture = p.getCameraImage(64, 64, view, lens, shadow=0, renderer=p.ER_BULLET_HARDWARE_OPENGL)[2]
box, beside = picture[32][32], picture[2][2]
drawn = box[0] > 2 * int(box[2]) and beside[2] > 100
print("\\nanswer: works" if drawn else "\\nanswer: fails", flush=True)
"""
