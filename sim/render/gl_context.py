"""An OpenGL context without a window, where moderngl is installed and a driver gives one."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from visctrl.hal.errors import InputError
from visctrl.sim.render.probe import answer

if TYPE_CHECKING:
    import moderngl

_VERSION = 330
# Elsewhere than on Linux, moderngl's own choice needs no display.
_OPTIONS: dict[str, Any] = {"backend": "egl"} if sys.platform == "linux" else {}
_REMEDY = "install one (on Debian: libegl1 libgl1 libgl1-mesa-dri), or use renderer 'tiny'"


def gl_problem() -> str:
    """Return why renderer ``gl`` cannot be used here and what to do, "" if it can.

    Found in another process: a driver may crash or hang.
    """
    if find_spec("moderngl") is None:
        return "moderngl is not installed: pip install 'visctrl[gl]', or use renderer 'tiny'"
    said = answer(_PROBE)
    if said is None:
        return f"the OpenGL driver crashes or hangs: {_REMEDY}"
    return "" if said == "works" else f"no OpenGL 3.3 driver draws here ({said}): {_REMEDY}"


def open_context() -> moderngl.Context:
    """Return a new context, to be used as a context manager only: it is then current.

    Raises
    ------
    InputError
        It cannot be had; the message is that of `gl_problem`.
    """
    if problem := gl_problem():
        raise InputError(f"renderer 'gl': {problem}")
    import moderngl

    try:
        return moderngl.create_context(standalone=True, require=_VERSION, **_OPTIONS)
    except Exception as error:
        raise InputError(f"renderer 'gl': no further OpenGL context ({error}): {_REMEDY}") from None


#: Clears a picture to a grey and looks whether it is there.
_PROBE = f"""
import moderngl
try:
    context = moderngl.create_context(standalone=True, require={_VERSION}, **{_OPTIONS!r})
    target = context.framebuffer([context.renderbuffer((8, 8), 1)])
    target.clear(red=0.5)
    drawn = set(target.read(components=1, alignment=1))
    print("answer: works" if drawn <= {{127, 128}} else "answer: it draws nothing", flush=True)
except Exception as error:
    print("answer:", error, flush=True)
"""
