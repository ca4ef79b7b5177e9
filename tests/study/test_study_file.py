"""What a study file asks for, and what is refused before anything runs."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from visctrl.robots.errors import InputError
from visctrl.studies.grid import Draw, Study, study_names
from visctrl.studies.loading import LoadedStudy, load_study

GRID = {"mock.noise_px": [0.0, 1.0], "controller.tau_s": [10.0, 12.0, 14.0]}


def loaded(folder: Path, study: dict[str, Any]) -> LoadedStudy:
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump(study))
    return load_study(str(path))


def trials(study: Study) -> dict[str, dict[str, Any]]:
    """Return every run's own values, by cell and number."""
    return {
        json.dumps([cell, number], sort_keys=True): study.trial(cell, number)
        for cell in study.cells()
        for number in range(study.repeats)
    }


def test_cells_are_every_combination_and_the_last_axis_changes_fastest() -> None:
    study = Study.model_validate({"grid": GRID, "starts": [(0, -1, 0), (0, -2, 5)], "runs": 3})
    cells = list(study.cells())
    assert study.count == 2 * 3 * 2 * 3 == 3 * len(cells)
    expected = itertools.product(*GRID.values(), (-1.0, -2.0))
    found = [(*(cell[key] for key in GRID), cell["start.y_m"]) for cell in cells]
    assert found == list(expected)


@pytest.mark.parametrize(
    ("span", "expected"),
    [
        ({"linear": [0, 1, 5]}, [0, 0.25, 0.5, 0.75, 1]),
        ({"log": [0.1, 10, 3]}, [0.1, 1, 10]),
    ],
)
def test_spans_are_written_out(span: dict[str, Any], expected: list[float]) -> None:
    study = Study.model_validate({"grid": {"mock.noise_px": span}})
    assert study.grid["mock.noise_px"] == pytest.approx(expected)


@given(seed=st.integers(0, 2**40), extra=st.floats(2.0, 50.0))
@settings(max_examples=20, deadline=None)
def test_a_study_that_grows_keeps_the_runs_it_had(seed: int, extra: float) -> None:
    """Also when a value is put before the others, and when each cell gets more runs."""
    random = {"start.x_m": {"uniform": [-1, 1]}}
    small = Study.model_validate(
        {"grid": {"mock.noise_px": [0.0, 1.0]}, "random": random, "runs": 2, "seed": seed}
    )
    large = Study.model_validate(
        {"grid": {"mock.noise_px": [extra, 0.0, 1.0]}, "random": random, "runs": 3, "seed": seed}
    )
    before, after = trials(small), trials(large)
    assert before.items() <= after.items()
    assert len({trial["seed"] for trial in after.values()}) == large.count


def test_paired_cells_differ_in_nothing_but_the_grid() -> None:
    random = {"start.x_m": {"normal": [0, 1]}}
    study = Study.model_validate({"grid": GRID, "random": random, "runs": 4, "paired": True})
    for number in range(4):
        rest = [
            {key: value for key, value in study.trial(cell, number).items() if key not in GRID}
            for cell in study.cells()
        ]
        assert rest == rest[:1] * len(rest)


def test_given_seeds_are_used_in_every_cell() -> None:
    study = Study.model_validate({"grid": GRID, "seeds": [5, 3]})
    for cell in study.cells():
        assert [study.trial(cell, number)["seed"] for number in range(2)] == [5, 3]


@pytest.mark.parametrize(
    ("draw", "mean", "low", "high"),
    [
        ({"uniform": [-1, 3]}, 1.0, -1.0, 3.0),
        ({"log_uniform": [0.01, 100]}, 99.99 / math.log(1e4), 0.01, 100.0),
        ({"normal": [2, 0.5]}, 2.0, -2.0, 6.0),
        ({"integer": [1, 6]}, 3.5, 1, 6),
        ({"choice": [1, 10]}, 5.5, 1, 10),
    ],
)
def test_draws_have_the_distribution_they_name(
    draw: dict[str, Any], mean: float, low: float, high: float
) -> None:
    rng = np.random.default_rng(1)
    values = [Draw.model_validate(draw).value(rng) for _ in range(4000)]
    assert low <= min(values)
    assert max(values) <= high
    standard_error = float(np.std(values)) / math.sqrt(len(values))
    assert abs(float(np.mean(values)) - mean) < 4 * standard_error


@pytest.mark.parametrize(
    ("study", "message"),
    [
        ({}, "nothing to run"),
        ({"settings": {"robot": "p3at"}}, "nothing to run"),
        ({"runs": 0}, "key 'runs'"),
        ({"grid": {"mock.noise_px": []}}, "key 'grid.mock.noise_px'"),
        ({"starts": []}, "key 'starts'"),
        ({"runs": 2, "rums": 3}, "unknown key 'rums'; known: .*did you mean 'runs'"),
        ({"runs": 2, "seeds": [1]}, "'runs' or 'seeds'"),
        ({"seeds": [1, 1]}, "seeds: 1 is there twice"),
        ({"grid": {"mock.noise_px": [1, 2, 1.0]}}, "mock.noise_px: 1.0 is there twice"),
        ({"grid": {"seed": [1, 2]}}, "study's own seed"),
        ({"grid": {"a..b": [1]}}, "'a..b' is not a dotted key"),
        ({"grid": {"start.x_m": [0]}, "starts": [[0, -1, 0]]}, "set the same value"),
        ({"settings": {"start": {"x_m": 1}}, "grid": {"start.x_m": [0]}}, "set the same value"),
        ({"grid": {"mock.noise_px": {"linear": [0, 1, 100_001]}}}, "more than 100000"),
        ({"grid": {"mock.noise_px": {"lin": [0, 1, 3]}}}, "unknown key 'grid.mock.noise_px.lin'"),
        ({"random": {"start.x_m": {}}}, "exactly one distribution of uniform"),
        ({"random": {"start.x_m": {"uniform": [1, 0]}}}, "the lower bound comes first"),
        ({"random": {"start.x_m": {"log_uniform": [0, 1]}}}, "must be positive"),
        ({"random": {"start.x_m": {"normal": [0, -1]}}}, "not negative"),
        ({"random": {"start.x_m": {"normale": [0, 1]}}}, "unknown key 'random.start.x_m.normale'"),
        ({"runs": 2, "scenario": "mok"}, "key 'scenario': unknown scenario 'mok'.*'mock'"),
        ({"runs": 2, "scenario": "mok.yaml"}, "key 'scenario': .*mok.yaml: no such file"),
    ],
)
def test_a_study_that_makes_no_sense_is_refused(
    tmp_path: Path, study: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message) as refusal:
        loaded(tmp_path, study)
    assert str(tmp_path / "mine.yaml") in str(refusal.value)


@pytest.mark.parametrize(
    ("study", "message"),
    [
        ({"grid": {"mock.noise_px": [0, -1]}}, r"mine.yaml: grid: mock: key 'noise_px'.*got -1"),
        ({"grid": {"mock.nois_px": [1]}}, "unknown key 'nois_px'.*did you mean 'noise_px'"),
        ({"settings": {"robbot": "p3at"}, "runs": 1}, "mine.yaml: settings: unknown key 'robbot'"),
        ({"grid": {"robot": ["p3dx", "p4"]}}, "mine.yaml: grid: key 'robot'.*p4"),
        ({"starts": [[0, -1, 0], [0, -101, 0]]}, "mine.yaml: starts: key 'start.y_m'.*-101"),
        ({"random": {"mock.noise_px": {"uniform": [-1, 0]}}}, "mine.yaml: random.*'noise_px'"),
        ({"grid": {"controller.tau_s": [5, 0]}}, "mine.yaml: grid: controller: key 'tau_s'"),
        ({"settings": {"realtime": True}, "runs": 1}, "as fast as it can"),
        ({"settings": {"backend": "pioneer"}, "runs": 1}, "simulated robots only"),
        ({"settings": {"seed.x": 1}, "runs": 1}, "mine.yaml: settings: key 'seed'"),
    ],
)
def test_a_value_that_the_scenario_refuses_is_found_before_anything_runs(
    tmp_path: Path, study: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        loaded(tmp_path, study).check()


def test_a_scenario_beside_the_study_is_found(tmp_path: Path) -> None:
    (tmp_path / "beside.yaml").write_text("backend: mock\nrobot: p3at\n")
    study = loaded(tmp_path, {"scenario": "beside.yaml", "runs": 2})
    study.check()
    assert [trial.scenario["robot"] for trial in study.runs()] == ["p3at", "p3at"]


def test_a_run_is_another_one_when_a_file_that_it_names_has_changed(tmp_path: Path) -> None:
    from visctrl.hal.cameras.catalogue import load_camera

    camera = load_camera("fisheye")
    file = tmp_path / "camera.yaml"
    keys = []
    for fx in (camera.fx, camera.fx + 1.0):
        file.write_text(yaml.safe_dump({**camera.model_dump(mode="json"), "fx": fx}))
        study = loaded(tmp_path, {"settings": {"camera.name": str(file)}, "runs": 1})
        study.check()
        keys += [trial.key for trial in study.runs()]
    assert len(set(keys)) == 2


@pytest.mark.parametrize("name", study_names())
def test_the_studies_that_are_shipped_can_be_run(name: str) -> None:
    study = load_study(name)
    study.check()
    assert study.study.title


def test_the_example_in_the_documentation_can_be_run(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "study.md").read_text(encoding="utf-8")
    example = text.partition("```yaml\n")[2].partition("```")[0]
    study = loaded(tmp_path, yaml.safe_load(example))
    study.check()
    assert study.study.count == 4 * 3 * 2 * 25
