"""The guide's example plugin works as printed."""

import re
from pathlib import Path

import pytest

from visctrl.robots.errors import InputError
from visctrl.runtime.config import load_scenario, parse_setting
from visctrl.runtime.plan import make_plan
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.session import run_session

GUIDE = Path(__file__).parent.parent / "docs" / "plugins.md"


@pytest.fixture
def example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    blocks = re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    for name, code in zip(("polar.py", "line.py", "rover.py"), blocks, strict=True):
        (tmp_path / name).write_text(code, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    return "controller.name=polar:Polar"


def plan_with(*settings: str):
    overrides = [parse_setting(text) for text in ("backend=mock", *settings)]
    return make_plan(load_scenario("default", overrides, REGISTRIES.backends.names()))


def test_the_example_reaches_the_target(example: str) -> None:
    outcome = run_session(plan_with(example))
    assert outcome.summary["status"] == "reached", outcome.summary["reason"]


def test_a_misspelt_option_of_the_example_is_named(example: str) -> None:
    with pytest.raises(InputError, match=r"k_roh.*did you mean 'k_rho'"):
        plan_with(example, "controller.k_roh=1")


@pytest.mark.usefixtures("example")
@pytest.mark.parametrize(("x", "status"), [(1.2, "reached"), (-0.2, "missed")])
def test_the_obstacle_provider_keeps_the_robot_on_its_side(x: float, status: str) -> None:
    """A line beside the way does no harm; one that the way crosses cannot be passed."""
    settings = ("scheme=pose", f"obstacles=[{{name: 'line:Line', x_m: {x}}}]", "duration_s=50")
    assert run_session(plan_with(*settings)).summary["status"] == status
