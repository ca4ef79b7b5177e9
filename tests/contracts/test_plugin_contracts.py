"""What every plugin of the registries must be."""

from __future__ import annotations

import inspect

import pytest

from robots.documents import Document
from visctrl.plugins import Estimate, Plugin, Signal
from visctrl.runtime.registry import REGISTRIES, Registry, estimate_type, options_type

PLUGINS = [
    pytest.param(registry, name, id=f"{registry.kind} {name}")
    for registry in (REGISTRIES.perception, REGISTRIES.estimators, REGISTRIES.controllers)
    for name in registry.names()
]


@pytest.mark.parametrize(("registry", "name"), PLUGINS)
def test_plugins_keep_their_contract(registry: Registry[Plugin[Document]], name: str) -> None:
    cls = registry.load(name)
    assert options_type(cls, name)(), "every option has a default"
    assert list(inspect.signature(cls).parameters) == ["options", "context"]
    assert all(isinstance(signal, Signal) for signal in cls.signals)
    names = [signal.name for signal in cls.signals]
    assert len(set(names)) == len(names)
    assert not any("." in name or "[" in name for name in names), "they become column names"


@pytest.mark.parametrize("name", REGISTRIES.estimators.names())
def test_estimators_say_what_they_give(name: str) -> None:
    assert estimate_type(REGISTRIES.estimators.load(name)) is not None


@pytest.mark.parametrize("name", REGISTRIES.controllers.names())
def test_controllers_say_what_they_accept(name: str) -> None:
    accepts = REGISTRIES.controllers.load(name).accepts
    assert issubclass(accepts, Estimate)
    assert accepts is not Estimate
