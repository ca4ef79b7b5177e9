from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from visctrl.robots.errors import InputError
from visctrl.runtime.config import load_scenario, parse_setting
from visctrl.runtime.plan import Plan, make_plan
from visctrl.runtime.registry import Registries, estimate_type
from visctrl.runtime.session import run_session

PLUGINS = """
import sys
from visctrl.schemes.pose.estimate import PoseEstimate
from visctrl.contracts import Controller, Decision, Estimate, Obstacle, ObstacleProvider
from visctrl.robots.documents import StrictModel

class Options(StrictModel):
    speed: float = 0.1

class Good(Controller):
    Options = Options
    accepts = Estimate
    def update(self, estimate, sent, dt):
        return Decision(finished=True)

class WallOptions(StrictModel):
    y_m: float = 1.0

class Wall(ObstacleProvider):
    Options = WallOptions
    accepts = PoseEstimate
    def update(self, estimate, ranges, now):
        return [Obstacle(0.0, self.options.y_m - estimate.pose.y, 0.1)] if estimate.known else []

class Unfinished(Controller):
    Options = Options

class NoOptions(Good):
    Options = dict

not_a_class = 3
"""

ENTRY_POINTS = """
[visctrl.controllers]
good = third_party:Good
unfinished = third_party:Unfinished
no-options = third_party:NoOptions
number = third_party:not_a_class
gone = third_party_gone:Good
misspelt = third_party:God

[visctrl.obstacles]
wall = third_party:Wall
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Registries:
    """Registries where a third party's package is installed."""
    info = tmp_path / "third_party-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: third-party\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    (tmp_path / "third_party.py").write_text(PLUGINS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "third_party", raising=False)
    return Registries()


def test_entry_points_extend_the_table_and_load_on_use(installed: Registries) -> None:
    assert "good" in installed.controllers.names()
    assert installed.controllers.target("good") == "third_party:Good"
    assert "third_party" not in sys.modules
    assert installed.controllers.load("good").__name__ == "Good"


def test_a_third_party_tells_of_obstacles(installed: Registries, tmp_path: Path) -> None:
    def plan(*settings: str) -> Plan:
        chosen = ("scheme=pose", "obstacles=[{name: wall, y_m: 1.5}]", *settings)
        overrides = [parse_setting(text) for text in chosen]
        return make_plan(load_scenario("mock", overrides, installed.backends.names()), installed)

    assert "wall" in installed.obstacles.names()
    chosen = plan()
    assert chosen.effective()["obstacles"] == [{"name": "wall", "y_m": 1.5}]
    outcome = run_session(chosen)
    assert outcome.summary["status"] == "reached"
    # In the way, it stops the robot.
    outcome = run_session(plan("obstacles=[{name: wall, y_m: 0.1}]", "duration_s=5"))
    assert outcome.summary["status"] == "missed"
    with pytest.raises(InputError, match=r"obstacles\.0: unknown key 'why_m'.*did you mean 'y_m'"):
        plan("obstacles=[{name: wall, why_m: 1}]")


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (
            ["obstacles=[{name: sonar}]"],
            "obstacles.0: obstacle provider 'sonar' needs range sensors",
        ),
        (["obstacles=[{name: sonar}]", "scheme=trifocal"], "'sonar' needs PoseEstimate, estimator"),
        (
            ["obstacles=[{name: listed}]", "controller.name=third_party:Good"],
            "controller 'third_party:Good' does not avoid obstacles",
        ),
        (["obstacles=[{name: wall}, {name: wall}]"], "obstacles.1: .*'wall' is named twice"),
        (["obstacles=[{name: wal}]"], "unknown obstacle provider 'wal'; .*did you mean 'wall'"),
        (["obstacles=[{y_m: 1}]"], "obstacles.0.name' is missing"),
    ],
)
def test_providers_that_do_not_fit_are_refused(
    installed: Registries, settings: list[str], said: str
) -> None:
    overrides = [parse_setting(text) for text in ("scheme=pose", *settings)]
    with pytest.raises(InputError, match=said):
        make_plan(load_scenario("mock", overrides, installed.backends.names()), installed)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "unfinished",
            "controller 'unfinished' (third_party:Unfinished) does not implement update",
        ),
        ("number", "(third_party:not_a_class) is not a subclass of Controller"),
        ("gone", "cannot be loaded: No module named 'third_party_gone'"),
        ("misspelt", "cannot be loaded"),
        ("goood", "unknown controller 'goood'; known: "),
    ],
)
def test_broken_plugins_are_named(installed: Registries, name: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        installed.controllers.load(name)
    assert words in str(caught.value)


def test_estimators_say_what_they_give(registries: Registries) -> None:
    found = estimate_type(registries.estimators.load("toy"))
    assert found is not None
    assert found.__name__ == "ToyEstimate"


def test_backend_options_come_without_the_backend(
    monkeypatch: pytest.MonkeyPatch, registries: Registries
) -> None:
    def forbid(name: str) -> Callable[[], None]:
        raise AssertionError(f"{name} was loaded")

    monkeypatch.setattr(registries.backends, "load", forbid)
    assert "noise_px" in registries.backend_options("mock").model_fields
    assert "renderer" in registries.backend_options("sim").model_fields
