"""A whole run on pictures of the ray casting renderer, and what is said where there are none."""

from __future__ import annotations

import math

import pytest

from visctrl.cli import doctor
from visctrl.cli.main import main
from visctrl.runtime.config import CameraChoice, load_scenario, parse_setting
from visctrl.runtime.plan import make_plan
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.session import run_session
from visctrl.sim.render import gl_context
from visctrl.sim.render.renderer_choice import drawer_problem

pytestmark = pytest.mark.sim


def test_the_default_run_ends_where_it_does_with_the_default_renderer() -> None:
    if problem := drawer_problem("gl"):
        pytest.skip(problem)
    changes = [parse_setting(text) for text in ("sim.renderer=gl", "camera.width=400")]
    plan = make_plan(load_scenario("default", changes, REGISTRIES.backends.names()))
    summary = run_session(plan).summary
    error = summary["final_error"]
    assert summary["status"] == "reached"
    assert math.hypot(error["x_m"], error["y_m"]) < 0.002
    assert abs(error["phi_deg"]) < 0.2


def test_a_renderer_that_cannot_be_used_is_bad_input(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(gl_context, "find_spec", lambda name: None)
    monkeypatch.setattr("sys.argv", ["visctrl", "run", "--set", "sim.renderer=gl"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert "pip install 'visctrl[gl]'" in capsys.readouterr().err


def test_an_unknown_renderer_is_bad_input(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["visctrl", "run", "--set", "sim.renderer=vulkan"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    err = capsys.readouterr().err
    for word in ("sim.renderer", "'tiny'", "'gl'"):
        assert word in err


def test_the_doctor_says_which_renderers_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_drawing_times", lambda drawer, model: iter([12.3]))
    monkeypatch.setattr("visctrl.sim.render.renderer_choice.gl_problem", lambda: "")
    found = {each.what: each for each in doctor.renderers(CameraChoice())}
    assert set(found) == {"renderer gl", "renderer tiny"}
    assert found["renderer gl"].found == "12 ms a picture of 800x600"
    problem = "pip install 'visctrl[gl]'"
    monkeypatch.setattr("visctrl.sim.render.renderer_choice.gl_problem", lambda: problem)
    found = {each.what: each for each in doctor.renderers(CameraChoice())}
    assert found["renderer gl"].found == "does not work here"
    assert found["renderer gl"].remedy == "pip install 'visctrl[gl]'"
    assert found["renderer gl"].level is doctor.Level.OK
