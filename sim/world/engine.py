"""PyBullet, kept from talking on standard output and from ending the process.

It reports its build, its threads and its OpenGL context on the standard streams, below Python's
own; and where a display is missing it calls ``exit``. So its chatter is sent
nowhere, and what may not work is tried in another process first.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from visctrl.hal.errors import InputError
from visctrl.sim.render.probe import works

__all__ = [
    "connect",
    "connect_window",
    "disconnect",
    "engine_problem",
    "hands_over_arrays",
    "hushed",
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


def disconnect(client: int) -> None:
    """Close a client, and its window if it has one."""
    if pybullet.isConnected(client):
        with hushed():
            pybullet.disconnect(physicsClientId=client)


_WINDOW_PROBE = """
import pybullet
client = pybullet.connect(pybullet.GUI)
print("\\nanswer: works" if client >= 0 else "\\nanswer: fails", flush=True)
"""
