"""Names to classes, imported when they are used and not before.

A name comes from a table, which the package of the class declares in its ``__init__.py``, or from
an entry point of an installed package, in the group ``visctrl.perception``, ``visctrl.estimators``,
``visctrl.controllers``, ``visctrl.obstacles`` or ``visctrl.backends``.
``module:Class`` names a class directly; the module may also lie in the current folder.
"""

from __future__ import annotations

import inspect
import typing
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar, cast

import visctrl.perception
import visctrl.planning.providers
from visctrl.contracts import (
    Controller,
    Estimate,
    Estimator,
    ObstacleProvider,
    Perception,
    Signal,
)
from visctrl.hal.interfaces import Backend, BackendOptions
from visctrl.robots.documents import StrictModel, suggestion
from visctrl.robots.errors import InputError
from visctrl.robots.loading import load_object
from visctrl.runtime.schemes import declared, plugins_of_schemes

T = TypeVar("T")
Options = TypeVar("Options", bound=StrictModel)


class Registry(Generic[T]):
    """The classes of one kind, by name.

    Parameters
    ----------
    kind : str
        What an error message calls them.
    group : str
        Entry point group that extends the table.
    contract : type
        Abstract class that each must derive from.
    builtin : dict
        Name to ``module:Class``.
    """

    def __init__(self, kind: str, group: str, contract: type[Any], builtin: dict[str, str]) -> None:
        self.kind = kind
        self.group = group
        self.contract = contract
        self.builtin = builtin

    def names(self) -> list[str]:
        """Return the names that can be used here, sorted."""
        return sorted(self.builtin.keys() | self._extensions.keys())

    def target(self, name: str) -> str:
        """Return ``module:Class`` of a name.

        Raises
        ------
        InputError
            Unknown; the message lists the known names.
        """
        if ":" in name:
            return name
        if name in self.builtin:
            return self.builtin[name]
        if name in self._extensions:
            return self._extensions[name].value
        raise InputError(f"unknown {self.kind} '{name}'; {suggestion(name, self.names())}")

    def load(self, name: str) -> type[T]:
        """Import a class by name and check that it keeps its contract.

        Raises
        ------
        InputError
            Unknown name, a module that cannot be imported, or a class that is not what its
            kind asks for.
        LoadError
            Its code fails while it is imported.
        """
        target = self.target(name)
        found = load_object(target, f"{self.kind} '{name}' ({target})")
        return self._checked(found, name, target)

    @cached_property
    def _extensions(self) -> dict[str, EntryPoint]:
        return {point.name: point for point in entry_points(group=self.group)}

    def _checked(self, found: object, name: str, target: str) -> type[T]:
        where = f"{self.kind} '{name}' ({target})"
        if not (isinstance(found, type) and issubclass(found, self.contract)):
            raise InputError(f"{where} is not a subclass of {self.contract.__qualname__}")
        if inspect.isabstract(found):
            missing = ", ".join(sorted(getattr(found, "__abstractmethods__", ())))
            raise InputError(f"{where} does not implement {missing}")
        if hasattr(self.contract, "signals"):
            _check_plugin(found, self.contract, where)
        return cast(type[T], found)


def _check_plugin(plugin: type, contract: type, where: str) -> None:
    """Refuse a plugin that leaves out what its contract declares, or says it wrongly."""
    signals = getattr(plugin, "signals", ())
    if not (isinstance(signals, tuple) and all(isinstance(each, Signal) for each in signals)):
        raise InputError(f"{where}: 'signals' is not a tuple of visctrl.contracts.Signal")
    if "accepts" in contract.__annotations__:
        accepts = getattr(plugin, "accepts", None)
        if not (isinstance(accepts, type) and issubclass(accepts, Estimate)):
            raise InputError(
                f"{where} does not say which estimates it takes: set 'accepts' to a subclass of "
                "visctrl.contracts.Estimate"
            )


def options_type(owner: type, where: str, base: type[Options]) -> type[Options]:
    """Return the ``Options`` of a plugin or backend class; ``where`` opens the error message."""
    options = getattr(owner, "Options", None)
    if not (isinstance(options, type) and issubclass(options, base)):
        raise InputError(f"{where} has no 'Options' derived from {base.__module__}.{base.__name__}")
    return options


@cache
def estimate_type(estimator: type[Estimator[Any, Any]]) -> type[Estimate] | None:
    """Return what an estimator's ``update`` is declared to return, None where it is not said."""
    try:
        declared = typing.get_type_hints(estimator.update).get("return")
    except NameError:
        return None
    return declared if isinstance(declared, type) and issubclass(declared, Estimate) else None


@dataclass(frozen=True)
class Registries:
    """All registries. What is built in is declared by the packages that hold it."""

    perception: Registry[Perception[Any]] = field(
        default_factory=lambda: Registry(
            "perception",
            "visctrl.perception",
            Perception,
            dict(declared(visctrl.perception, "PERCEPTION")),
        )
    )
    estimators: Registry[Estimator[Any, Any]] = field(
        default_factory=lambda: Registry(
            "estimator", "visctrl.estimators", Estimator, plugins_of_schemes("ESTIMATORS")
        )
    )
    controllers: Registry[Controller[Any, Any]] = field(
        default_factory=lambda: Registry(
            "controller", "visctrl.controllers", Controller, plugins_of_schemes("CONTROLLERS")
        )
    )
    obstacles: Registry[ObstacleProvider[Any, Any]] = field(
        default_factory=lambda: Registry(
            "obstacle provider",
            "visctrl.obstacles",
            ObstacleProvider,
            dict(declared(visctrl.planning.providers, "OBSTACLES")),
        )
    )
    backends: Registry[Backend] = field(
        default_factory=lambda: Registry(
            "backend",
            "visctrl.backends",
            Backend,
            {
                "sim": "visctrl.sim.backend:SimBackend",
                "mock": "visctrl.hal.mock.backend:MockBackend",
                "pioneer": "visctrl.hal.pioneer.backend:PioneerBackend",
            },
        )
    )

    def backend_options(self, name: str) -> type[BackendOptions]:
        """Return the options of a backend, without importing what only a run needs."""
        target = _BACKEND_OPTIONS.get(name)
        if target is None:
            return options_type(self.backends.load(name), f"backend '{name}'", BackendOptions)
        return cast(type[BackendOptions], load_object(target, f"backend '{name}'"))


#: Where a backend's options live apart from the backend, which may import a physics engine.
_BACKEND_OPTIONS = {
    "sim": "visctrl.sim.options:SimOptions",
    "mock": "visctrl.hal.mock.backend:MockOptions",
}

REGISTRIES = Registries()
