"""An OpenGL context without a window, for those who have moderngl and a driver."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from hal.errors import InputError

if TYPE_CHECKING:
    import moderngl

_VERSION = 330


def open_context() -> moderngl.Context:
    """Return a new context. It is current only within a ``with`` statement.

    Raises
    ------
    InputError
        moderngl is not installed, or no OpenGL driver gives a context.
    """
    try:
        import moderngl
    except ImportError:
        raise InputError(
            "renderer 'gl' needs moderngl: pip install 'visctrl[gl]', or use renderer 'tiny'"
        ) from None
    # Elsewhere than on Linux, moderngl's own choice needs no display.
    options: dict[str, Any] = {"backend": "egl"} if sys.platform == "linux" else {}
    try:
        context = moderngl.create_context(standalone=True, require=_VERSION, **options)
    except Exception as error:
        raise InputError(
            f"renderer 'gl' gets no OpenGL context ({error}): install a driver (on Debian: "
            "libegl1 libgl1 libgl1-mesa-dri), or use renderer 'tiny'"
        ) from None
    with context:
        # Leaving the statement lets go of the context, which creating it has not.
        return context
