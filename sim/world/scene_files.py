"""Names of scenes and where their files are, without reading any."""

from __future__ import annotations

from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

from visctrl.hal.errors import InputError
from visctrl.robots.documents import suggestion


def scene_folder() -> Traversable:
    """Return the folder of this package's scenes (package data)."""
    return resources.files("visctrl.sim") / "scenes"


@cache
def scene_names() -> tuple[str, ...]:
    """Return the names of the scenes that this package holds."""
    files = (f.name for f in scene_folder().iterdir())
    return tuple(sorted(f.removesuffix(".yaml") for f in files if f.endswith(".yaml")))


def check_scene_name(name: str) -> str:
    """Return ``name`` if a scene goes by it, or a file is there if it ends in ``.yaml``.

    Raises
    ------
    InputError
        No such scene (the message lists those there are), or no such file.
    """
    if name.endswith((".yaml", ".yml")):
        if not Path(name).is_file():
            raise InputError(f"{name}: no such file")
    elif name not in scene_names():
        raise InputError(f"unknown scene '{name}'; {suggestion(name, scene_names())}")
    return name
