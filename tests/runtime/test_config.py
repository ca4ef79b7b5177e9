"""Every wrong scenario gives one message with file or option, key, and what was expected."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.files import write_camera
from visctrl.robots.errors import InputError
from visctrl.runtime.config import Override, load_scenario, parse_setting, scenario_names, to_yaml
from visctrl.runtime.plan import Plan, make_plan
from visctrl.runtime.registry import Registries

WriteScenario = Callable[[str], Path]


@pytest.fixture
def scenario(tmp_path: Path) -> WriteScenario:
    def write(text: str) -> Path:
        path = tmp_path / "scenario.yaml"
        path.write_text(text)
        return path

    return write


def plan(registries: Registries, name: str, *settings: str) -> Plan:
    overrides = [parse_setting(text) for text in settings]
    return make_plan(load_scenario(name, overrides, registries.backends.names()), registries)


TOY = """
backend: mock
estimator: {name: toy}
controller: {name: toy}
approach: {enabled: false}
"""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sed: 3", ["scenario.yaml", "unknown key 'sed'", "did you mean 'seed'"]),
        ("start: {x: 1}", ["unknown key 'start.x'", "known: phi_deg, x_m, y_m"]),
        ("seed: -1", ["key 'seed'", "greater than or equal to 0", "(got -1)"]),
        ("seed: many", ["key 'seed'", "integer", "'many'"]),
        ("rate_hz: 0", ["key 'rate_hz'", "greater than 0"]),
        ("duration_s: .inf", ["key 'duration_s'"]),
        ("start: {x_m: 1000}", ["key 'start.x_m'", "100"]),
        ("start: [0, 1]", ["key 'start'"]),
        ("approach: {timeout: 3}", ["unknown key 'approach.timeout'", "did you mean 'timeout_s'"]),
        ("mock: 3", ["key 'mock'", "expected a mapping"]),
        ("backends: {}", ["unknown key 'backends'"]),
        ("camera: {name: [1]}", ["key 'camera.name'", "string"]),
        ("- a\n- b", ["expected a mapping"]),
        ("a: [", ["scenario.yaml:2", "not valid YAML"]),
    ],
)
def test_wrong_files_are_explained(scenario: WriteScenario, text: str, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        load_scenario(str(scenario(text)), (), ["mock", "sim"])
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("backend: simm", ["key 'backend'", "unknown backend 'simm'", "did you mean 'sim'"]),
        ("robot: p3dy", ["key 'robot'", "unknown robot 'p3dy'", "p3at, p3dx", "'p3dx'?"]),
        ("camera: {name: fish}", ["key 'camera'", "unknown camera 'fish'", "fisheye"]),
        ("camera: {name: nowhere.yaml}", ["key 'camera'", "nowhere.yaml", "no such file"]),
        ("camera: {mount: roof}", ["key 'camera.mount'", "centre, front"]),
        ("camera: {width: 333, height: 600}", ["key 'camera'", "aspect"]),
        ("camera_error: {xi: -5}", ["key 'camera_error'", "xi"]),
        ("scheme: trifocle", ["key 'scheme'", "unknown scheme", "did you mean 'trifocal'"]),
        ("controller: {name: toi}", ["key 'controller.name'", "did you mean 'toy'"]),
        ("controller: {nam: toy}", ["controller: unknown key 'nam'"]),
        ("controller: {name: toy, drive: 3}", ["controller: unknown key 'drive'", "'drive_s'?"]),
        ("controller: {name: toy, v: fast}", ["controller: key 'v'", "number", "'fast'"]),
        ("mock: {noise: 3}", ["mock: unknown key 'noise'", "did you mean 'noise_px'"]),
        ("mock: {near_m: 9}", ["near_m 9 must be less than far_m 8"]),
        ("mock: {faults: {camera_black_s: [3, 2]}}", ["faults.camera_black_s", "start < end"]),
        ("sim: {noise: 3}", ["sim: unknown key 'noise'"]),
        ("safety: {v_m_s: 99}", ["safety.v_m_s", "at most 1.2"]),
        ("perception: {min_features: 1}", ["perception: key 'min_features'"]),
    ],
)
def test_wrong_names_and_options_are_explained(
    scenario: WriteScenario, registries: Registries, text: str, words: list[str]
) -> None:
    data = {**yaml.safe_load(TOY), **yaml.safe_load(text)}
    path = scenario(to_yaml(data))
    with pytest.raises(InputError) as caught:
        plan(registries, str(path))
    message = str(caught.value)
    assert message.startswith(str(path))
    for word in words:
        assert word in message


def test_an_error_names_the_layer_that_holds_it(
    scenario: WriteScenario, registries: Registries
) -> None:
    path = str(scenario(TOY))
    with pytest.raises(InputError, match=r"^--set seed=x: key 'seed'"):
        plan(registries, path, "seed=x")
    with pytest.raises(InputError, match=r"scenario\.yaml, --set controller\.v=x: controller: key"):
        plan(registries, path, "controller.v=x", "seed=4")
    with pytest.raises(InputError, match=r"--set seed\.x=1: key 'seed' holds a value"):
        plan(registries, str(scenario(TOY + "seed: 3")), "seed.x=1")
    for text in ("seed", "=3", "a..b=3"):
        with pytest.raises(InputError, match="expected key=value"):
            parse_setting(text)
    with pytest.raises(InputError, match="not valid YAML"):
        parse_setting("seed=[")


def test_settings_are_yaml_and_later_ones_win(
    registries: Registries, scenario: WriteScenario
) -> None:
    path = str(scenario(TOY))
    made = plan(registries, path, "seed=3", "controller.v=0.3", "mock={noise_px: 1.5}", "seed=4")
    assert made.scenario.seed == 4
    assert made.main.controller.options.model_dump()["v"] == 0.3
    assert made.backend_options.model_dump()["noise_px"] == 1.5


def test_missing_files_and_unknown_scenarios(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_scenario(str(tmp_path / "none.yaml"))
    with pytest.raises(InputError, match=r"unknown scenario 'defaul'; .*did you mean 'default'"):
        load_scenario("defaul")


def test_plugins_that_do_not_fit_are_refused(
    scenario: WriteScenario, registries: Registries
) -> None:
    path = str(scenario(TOY + "\n"))
    with pytest.raises(InputError, match=r"controller 'toy' needs ToyEstimate, estimator 'tensor'"):
        plan(registries, path, "estimator.name=tensor")


def test_camera_sizes_follow_from_one_number(
    registries: Registries, scenario: WriteScenario
) -> None:
    made = plan(registries, str(scenario(TOY)), "camera.width=1024")
    assert (made.camera.width, made.camera.height) == (1024, 768)
    assert made.camera.fx == pytest.approx(117.0 * 1.28)


def test_the_true_camera_differs_by_what_is_asked(
    registries: Registries, scenario: WriteScenario
) -> None:
    path = str(scenario(TOY))
    assert plan(registries, path).true_camera == plan(registries, path).camera
    made = plan(registries, path, "camera_error={focal_scale: 0.5, cx_px: 20, tilt_deg: 3}")
    assert made.true_camera.fx == pytest.approx(0.5 * made.camera.fx)
    assert made.true_camera.cx == made.camera.cx + 20
    assert made.true_camera.pitch_deg == 3


def test_ideal_robots_have_no_limits(registries: Registries, scenario: WriteScenario) -> None:
    path = str(scenario(TOY))
    assert plan(registries, path, "mock.ideal=true").limits is None
    assert plan(registries, path).limits is not None


def test_the_resolved_scenario_is_a_fixed_point(
    registries: Registries, scenario: WriteScenario
) -> None:
    settings = ("camera.width=400", "mock.noise_px=0.7", "controller.v=0.11")
    first = plan(registries, str(scenario(TOY)), *settings).effective()
    second = plan(registries, str(scenario(to_yaml(first)))).effective()
    assert second == first
    assert first["controller"]["drive_s"] == 5.0, "plugin defaults are filled in"
    assert first["mock"]["features"] == 60, "and those of the backend"


@pytest.mark.parametrize("name", scenario_names())
def test_every_scenario_of_the_package_can_be_run(name: str) -> None:
    registries = Registries()
    loaded = load_scenario(name, (), registries.backends.names())
    assert loaded.scenario.title
    assert make_plan(loaded, registries).effective()["scheme"] == loaded.scenario.scheme


def test_overrides_know_where_they_came_from() -> None:
    overrides = [Override(("seed",), 3, "--seed 3"), Override(("robot",), "p3at", "--robot p3at")]
    overrides += [Override(("camera", "width"), 400, "--set camera.width=400")]
    loaded = load_scenario("default", overrides)
    assert loaded.origin_of("seed") == "--seed 3"
    assert loaded.origin_of("robot") == "--robot p3at"
    assert loaded.origin_of("camera").endswith("default.yaml, --set camera.width=400")
    assert loaded.origin_of("scheme").endswith("default.yaml")


def test_a_camera_may_be_another_programs_calibration(tmp_path: Path) -> None:
    path = tmp_path / "chain.yaml"
    write_camera(load_camera("hypercatadioptric").altered(cx=404.0), path, "kalibr")
    overrides = [
        Override(("camera", "name"), str(path), "--camera"),
        Override(("backend",), "mock", "--backend"),
    ]
    plan = make_plan(load_scenario("default", overrides))
    assert plan.camera.cx == 404.0
    assert plan.camera.optical_axis == "down"
