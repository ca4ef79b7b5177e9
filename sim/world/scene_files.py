"""Names of scenes and where their files are, without reading any."""

from __future__ import annotations

import os
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable

from visctrl.hal.errors import InputError
from visctrl.robots.documents import suggestion


def scene_folder() -> Traversable:
    """Return the folder of this package's scenes (package data)."""
    return resources.files("visctrl.sim") / "scenes"


#: What the name of a scene that is made from a seed begins with.
RANDOM = "random:"


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
        No such scene (the message lists those there are), no such file, or no seed after
        ``random:``.
    """
    if name.startswith(RANDOM):
        if not name.removeprefix(RANDOM).isdecimal():
            raise InputError(f"scene '{name}': expected a whole number, as in {RANDOM}7")
        return name
    if name.endswith((".yaml", ".yml")):
        if not os.path.isfile(name):
            raise InputError(f"{name}: no such file")
    elif name not in scene_names():
        raise InputError(f"unknown scene '{name}'; {suggestion(name, scene_names())}")
    return name
