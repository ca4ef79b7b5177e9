"""A plan of toy plugins on a mock whose devices are watched."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import toy_plugins
from toy_plugins import SpyBackend

from visctrl.runtime.config import Override, load_scenario
from visctrl.runtime.plan import Plan, make_plan
from visctrl.runtime.registry import Registries

TOY = {
    "backend": "spy",
    "perception.name": "features",
    "estimator.name": "toy",
    "controller.name": "toy",
    "approach.enabled": False,
    "final.enabled": False,
    "approach.estimator.name": "toy",
    "approach.controller.name": "toy-approach",
    "start.x_m": 0.0,
    "start.y_m": -1.0,
    "start.phi_deg": 0.0,
}


@pytest.fixture
def registries() -> Registries:
    found = Registries()
    found.backends.builtin["spy"] = "toy_plugins:SpyBackend"
    found.estimators.builtin["toy"] = "toy_plugins:ToyEstimator"
    found.controllers.builtin["toy"] = "toy_plugins:ToyController"
    found.controllers.builtin["toy-approach"] = "toy_plugins:ToyApproach"
    return found


@pytest.fixture
def toy_plan(registries: Registries) -> Callable[..., Plan]:
    """Return a function from settings (dotted keys) to a plan."""

    def plan(settings: dict[str, object] | None = None) -> Plan:
        merged = {**TOY, **(settings or {})}
        overrides = [Override(tuple(k.split(".")), v, f"--set {k}") for k, v in merged.items()]
        return make_plan(
            load_scenario("default", overrides, registries.backends.names()), registries
        )

    return plan


@pytest.fixture(autouse=True)
def _fresh_spy() -> Iterator[None]:
    SpyBackend.opened.clear()
    yield
    toy_plugins.ToyController.sleep = staticmethod(toy_plugins.time.sleep)
