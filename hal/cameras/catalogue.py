"""Cameras by name, and projection models by theirs.

A model is a file of `visctrl.hal.cameras.models`, found by its name; ``package.module:Class``
names one that lies elsewhere. A calibration that names none is of the unified sphere model.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping
from functools import cache
from importlib import resources
from types import ModuleType
from typing import Any

from visctrl.hal.cameras.central import CentralCamera
from visctrl.robots.documents import read_yaml, suggestion, validate
from visctrl.robots.errors import InputError
from visctrl.robots.loading import load_object

_MODELS = "visctrl.hal.cameras.models"
_DEFAULT = "unified"


@cache
def camera_names() -> tuple[str, ...]:
    """Return the names of the cameras that this package describes."""
    files = (resources.files("visctrl.hal") / "cameras").iterdir()
    return tuple(sorted(f.name.removesuffix(".yaml") for f in files if f.name.endswith(".yaml")))


@cache
def load_camera(name: str) -> CentralCamera:
    """Return a camera by name.

    Raises
    ------
    InputError
        No such camera; the message lists those there are.
    """
    if name not in camera_names():
        raise InputError(f"unknown camera '{name}'; {suggestion(name, camera_names())}")
    file = resources.files("visctrl.hal") / "cameras" / f"{name}.yaml"
    return parse_camera(read_yaml(file), str(file))


def parse_camera(data: Mapping[str, Any], origin: str) -> CentralCamera:
    """Return the camera that the keys of a calibration describe; ``origin`` is for messages.

    Raises
    ------
    InputError
        Unknown model, or a key that is wrong, missing or unknown.
    """
    return validate(data, model_class(str(data.get("model", _DEFAULT)), origin), origin)


@cache
def model_names() -> tuple[str, ...]:
    """Return the names of the projection models of this package."""
    files = (f.name for f in resources.files(_MODELS).iterdir())
    stems = (f.removesuffix(".py") for f in files if f.endswith(".py") and f[0] != "_")
    return tuple(sorted(stem.replace("_", "-") for stem in stems))


def model_class(name: str, origin: str = "camera") -> type[CentralCamera]:
    """Return the class of a projection model; ``origin`` opens the error message.

    Raises
    ------
    InputError
        No such model, or what it names is none.
    """
    if ":" in name:
        found = load_object(name, f"{origin}: model '{name}'")
        if not (isinstance(found, type) and issubclass(found, CentralCamera)):
            raise InputError(f"{origin}: model '{name}' is not derived from CentralCamera")
        return found
    if name not in model_names():
        raise InputError(f"{origin}: unknown model '{name}'; {suggestion(name, model_names())}")
    return _camera_of(importlib.import_module(f"{_MODELS}.{name.replace('-', '_')}"))


def _camera_of(module: ModuleType) -> type[CentralCamera]:
    """Return the camera class that a module defines."""
    (found,) = (
        member
        for _, member in inspect.getmembers(module, inspect.isclass)
        if issubclass(member, CentralCamera) and member.__module__ == module.__name__
    )
    return found
