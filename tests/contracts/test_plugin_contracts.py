"""What every plugin of the registries must be."""

from __future__ import annotations

import inspect
import math

import numpy as np
import pytest

from visctrl.contracts import Context, Estimate, Health, Obstacle, Plugin, Signal
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.types import Pose, Range
from visctrl.robots import load_robot
from visctrl.robots.documents import StrictModel
from visctrl.runtime.registry import REGISTRIES, Registry, estimate_type, options_type
from visctrl.schemes.pose.estimate import Need, PoseEstimate

PLUGINS = [
    pytest.param(registry, name, id=f"{registry.kind} {name}")
    for registry in (
        *(REGISTRIES.perception, REGISTRIES.estimators, REGISTRIES.controllers),
        REGISTRIES.obstacles,
    )
    for name in registry.names()
]


@pytest.mark.parametrize(("registry", "name"), PLUGINS)
def test_plugins_keep_their_contract(registry: Registry[Plugin[StrictModel]], name: str) -> None:
    cls = registry.load(name)
    assert options_type(cls, name, StrictModel)(), "every option has a default"
    assert list(inspect.signature(cls).parameters) == ["options", "context"]
    assert all(isinstance(signal, Signal) for signal in cls.signals)
    names = [signal.name for signal in cls.signals]
    assert len(set(names)) == len(names)
    assert not any("." in name or "[" in name for name in names), "they become column names"


@pytest.mark.parametrize("name", REGISTRIES.obstacles.names())
def test_providers_say_what_they_accept_and_whether_they_listen(name: str) -> None:
    cls = REGISTRIES.obstacles.load(name)
    assert issubclass(cls.accepts, Estimate)
    assert cls.accepts is not Estimate
    assert isinstance(cls.listens, bool)


@pytest.mark.parametrize("name", REGISTRIES.obstacles.names())
@pytest.mark.parametrize("need", [Need.STILL, Need.FORWARD, Need.NOTHING])
def test_providers_answer_whatever_the_estimate_and_the_sensors_say(name: str, need: Need) -> None:
    """Before the pose is known, without sensors, with old readings: obstacles, never an error."""
    cls = REGISTRIES.obstacles.load(name)
    camera = load_camera("hypercatadioptric")
    context = Context(camera, None, 0.1, 0.1, 0, True, load_robot("p3dx").body)
    provider = cls(options_type(cls, name, StrictModel)(), context)
    pose = Pose(0.4, -2.0, 0.3)
    readings = [Range(0.1, 0.2, 0.4, 1.0), Range(0.0, 0.2, 0.0, math.inf, 0.3), Range(0, 0, 0, 0)]
    for tick, ranges in enumerate(([], readings, readings, [])):
        estimate = PoseEstimate(
            health=Health.OK, pose=pose, covariance=1e-4 * np.eye(3), initial=pose, need=need
        )
        found = provider.update(estimate, ranges if cls.listens else (), 0.1 * tick)
        assert all(isinstance(each, Obstacle) for each in found)
        assert all(math.isfinite(number) for each in found for number in each[:3])
        assert all(each.radius >= 0.0 for each in found)
    assert all(isinstance(each, Obstacle) for each in provider.expected())
    assert set(provider.values()) <= {signal.name for signal in cls.signals}
    assert all(isinstance(note, str) for note in provider.notes())
    provider.close()


@pytest.mark.parametrize("name", REGISTRIES.estimators.names())
def test_estimators_say_what_they_give(name: str) -> None:
    assert estimate_type(REGISTRIES.estimators.load(name)) is not None


@pytest.mark.parametrize("name", REGISTRIES.controllers.names())
def test_controllers_say_what_they_accept(name: str) -> None:
    accepts = REGISTRIES.controllers.load(name).accepts
    assert issubclass(accepts, Estimate)
    assert accepts is not Estimate
