"""Schemes and their plugins, as the folders of ``visctrl/schemes`` declare them."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from types import ModuleType

import visctrl.schemes
from visctrl.robots.documents import suggestion
from visctrl.robots.errors import InputError
from visctrl.schemes.scheme import Scheme


@cache
def schemes() -> dict[str, Scheme]:
    """Return every scheme by name, which is its folder's."""
    return {
        folder.__name__.rpartition(".")[2]: folder.SCHEME
        for folder in _folders()
        if hasattr(folder, "SCHEME")
    }


def scheme_named(name: str) -> Scheme:
    """Return a scheme by name.

    Raises
    ------
    InputError
        No such scheme; the message lists those there are.
    """
    if name not in schemes():
        raise InputError(f"unknown scheme '{name}'; {suggestion(name, schemes())}")
    return schemes()[name]


def plugins_of_schemes(kind: str) -> dict[str, str]:
    """Return name to ``module:Class`` of the schemes' plugins.

    Parameters
    ----------
    kind : str
        The table that a folder declares: ``ESTIMATORS`` or ``CONTROLLERS``.
    """
    return {name: target for folder in _folders() for name, target in declared(folder, kind)}


def declared(package: ModuleType, kind: str) -> Iterator[tuple[str, str]]:
    """Yield (name, ``module:Class``) of what a package declares in its table ``kind``."""
    for name, target in getattr(package, kind, {}).items():
        yield name, f"{package.__name__}.{target}"


def _folders() -> Iterator[ModuleType]:
    for module in pkgutil.iter_modules(visctrl.schemes.__path__):
        if module.ispkg:
            yield import_module(f"visctrl.schemes.{module.name}")
