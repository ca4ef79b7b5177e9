"""Visual control of wheeled mobile robots: drive to the pose of a target image.

>>> import visctrl
>>> run = visctrl.run("mock", start=(-0.55, -1.35, -35), seed=0)
>>> run.status, run.errors.distance_cm < 1.0
('reached', True)
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from visctrl.api import Run, Session, replay, run, session, study, teach

__version__ = "0.1.0"
__all__ = ["Run", "Session", "__version__", "replay", "run", "session", "study", "teach"]


_here = Path(__file__).parent
if not (_here / "hal").is_dir():
    # A checkout whose file system, or whose Git, has no symbolic links: the folders that the
    # links name lie beside this one.
    if not (_here.parent / "hal" / "interfaces.py").is_file():
        raise ImportError(
            f"{_here} is incomplete: neither visctrl/hal nor ../hal is there. Check the "
            "repository out as a whole, or install the package: pip install visctrl"
        )
    __path__.append(str(_here.parent))


def __getattr__(name: str) -> Any:
    """Import the interface when it is used: the command line's help needs none of it."""
    if name in __all__:
        from visctrl import api

        return getattr(api, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
