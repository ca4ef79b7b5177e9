"""Visual control of wheeled mobile robots: drive to the pose of a target image."""

from pathlib import Path

__version__ = "0.1.0"

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
