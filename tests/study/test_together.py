"""Studies whose runs are driven together: the same table, whoever works and in what groups."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import yaml

from visctrl.montecarlo.kinds import batchable
from visctrl.robots.errors import InputError
from visctrl.runtime.interrupts import Interrupts
from visctrl.runtime.session import run_session
from visctrl.study import runner as study_runs
from visctrl.study.grid import Study
from visctrl.study.log import LOG, StudyLog
from visctrl.study.runner import Group, plan_of, run_group, run_study, table_rows
from visctrl.study.table import row_of, write_table
from visctrl.study.trials import load_study
from visctrl.study.workers import Died, LocalWorkers, Results, Workers

#: Cells that can be driven together, cells that cannot, and one whose runs are refused.
STUDY: dict[str, Any] = {
    "settings": {"duration_s": 3, "mock.noise_px": 0.5},
    "grid": {"controller.law": ["practical", "published"], "mock.features": [60, 2]},
    "random": {
        "start.x_m": {"uniform": [-0.5, 0.5]},
        "start.phi_deg": {"uniform": [-30, 30]},
    },
    "runs": 4,
}


class Here:
    """Works in this process; a group is lost when it holds more than one run, if told so."""

    def __init__(self, count: int = 1, *, lossy: bool = False) -> None:
        self.count, self.lossy = count, lossy
        self.sizes: list[int] = []

    def each(self, work: Callable[[Any], Any], items: Iterable[Any]) -> Results[Any, Any]:
        for item in items:
            self.sizes.append(len(item.trials))
            lost = self.lossy and (len(item.trials) > 1 or item.trials[0].index == 2)
            yield item, Died("the worker died") if lost else work(item)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("together"), STUDY)


@pytest.fixture(scope="module")
def expected(file: Path) -> bytes:
    return table(file, file.parent / "expected", Here())


def written(folder: Path, study: dict[str, Any]) -> Path:
    path = folder / "study.yaml"
    path.write_text(yaml.safe_dump(study, sort_keys=False))
    return path


def table(file: Path, folder: Path, workers: Workers) -> bytes:
    study = load_study(str(file))
    study.check()
    with StudyLog(folder) as log, Interrupts() as interrupts:
        died = run_study(study, log, workers, interrupts)
        [path, *_] = write_table(table_rows(study, log, died), folder)
    return path.read_bytes()


def rows_of(content: bytes) -> list[dict[str, str]]:
    return list(csv.DictReader(content.decode().splitlines()))


def test_runs_of_a_kind_are_driven_together_and_others_alone(file: Path, tmp_path: Path) -> None:
    workers = Here()
    found = rows_of(table(file, tmp_path, workers))
    assert workers.sizes == [4, 4, *[1] * 8]
    statuses = [(row["mock.features"], row["status"]) for row in found]
    assert statuses == [*[("60", "missed")] * 4, *[("2", "refused")] * 4] * 2


def test_the_table_is_that_of_single_runs(file: Path, tmp_path: Path, expected: bytes) -> None:
    """To 1e-7 cm and deg; words and counts exactly."""
    single = table(written(tmp_path, {**STUDY, "batched": False}), tmp_path / "out", Here())
    for mine, its in zip(rows_of(expected), rows_of(single), strict=True):
        for key, value in its.items():
            if key in ("distance_cm", "x_cm", "y_cm", "phi_deg", "path_m", "time_s") and value:
                assert abs(float(mine[key]) - float(value)) < 1e-7
            else:
                assert mine[key] == value


@pytest.mark.parametrize(("workers", "most"), [(1, 3), (3, 256), (9, 256)])
def test_the_table_does_not_depend_on_the_groups(
    file: Path,
    tmp_path: Path,
    expected: bytes,
    monkeypatch: pytest.MonkeyPatch,
    workers: int,
    most: int,
) -> None:
    monkeypatch.setattr(study_runs, "BATCH", most)
    assert table(file, tmp_path, Here(workers)) == expected


def test_two_processes_give_the_same_table(file: Path, tmp_path: Path, expected: bytes) -> None:
    assert table(file, tmp_path, LocalWorkers(2)) == expected


def test_a_study_goes_on_with_what_is_missing(file: Path, tmp_path: Path, expected: bytes) -> None:
    finished = (file.parent / "expected" / LOG).read_bytes().splitlines(keepends=True)
    kept = [finished[0], *finished[2::3]]
    (tmp_path / LOG).write_bytes(b"".join(kept) + b'{"key": "cut sh')
    assert table(file, tmp_path, Here()) == expected
    after = (tmp_path / LOG).read_bytes().splitlines(keepends=True)
    assert after[: len(kept)] == kept
    keys = [json.loads(line)["key"] for line in after[1:]]
    assert len(keys) == len(set(keys)) == 16


def test_a_group_that_kills_its_worker_is_tried_run_by_run(
    file: Path, tmp_path: Path, expected: bytes
) -> None:
    """Run 2 kills it every time; it is named, and the next call goes on with it alone."""
    found, whole = rows_of(table(file, tmp_path, Here(lossy=True))), rows_of(expected)
    assert [row["status"] for row in found].count("died") == 1
    assert (found[2]["status"], found[2]["reason"]) == ("died", "the worker died")
    del found[2], whole[2]
    assert found == whole
    workers = Here()
    assert table(file, tmp_path, workers) == expected
    assert workers.sizes == [1]


@pytest.mark.parametrize(
    ("change", "together"),
    [
        ({}, True),
        ({"batched": False}, False),
        # No two runs differ in nothing but start and seed.
        ({"random": {"mock.far_m": {"uniform": [5, 9]}}}, False),
        ({"random": {}, "runs": 1}, False),
        ({"random": {}, "runs": 1, "starts": [[0, -2, 0], [0, -3, 0]]}, True),
        ({"random": {}, "runs": 1, "grid": {"start.y_m": [-2, -3]}}, True),
    ],
)
def test_when_runs_are_driven_together(change: dict[str, Any], together: bool) -> None:
    assert Study.model_validate({**STUDY, **change}).together == together


def test_results_of_both_ways_are_not_mixed(file: Path, tmp_path: Path) -> None:
    """They differ in the last digit: a folder holds those of one way."""
    table(file, tmp_path, Here())
    other = written(tmp_path, {**STUDY, "batched": False})
    with pytest.raises(InputError, match="another study"):
        table(other, tmp_path, Here())


def test_every_draw_is_checked_though_its_kind_is_known(tmp_path: Path) -> None:
    """A heading that is drawn beyond what the scenario takes, now and then."""
    wide = {"start.phi_deg": {"uniform": [-450, 450]}}
    file = written(tmp_path, {**STUDY, "random": wide, "runs": 30})
    with pytest.raises(InputError, match=r"study.yaml: random: key 'start.phi_deg'.*360"):
        load_study(str(file)).check()


@pytest.mark.parametrize("name", ["far-starts", "noise"])
def test_shipped_studies_give_what_single_runs_give(name: str) -> None:
    """Three runs out of the first cell and three out of the second, with and without noise."""
    study = load_study(name)
    runs = study.study.repeats
    trials = [trial for trial in islice(study.trials(), 2 * runs) if trial.index % runs < 3]
    for cell in (trials[:3], trials[3:]):
        rows = run_group(Group(tuple(cell), together=True))
        for trial, row in zip(cell, rows, strict=True):
            assert batchable(plan_of(trial))
            single = row_of(run_session(plan_of(trial)).summary)
            numbers = {key for key, value in single.items() if isinstance(value, float)}
            assert {"distance_cm", "phi_deg", "path_m", "time_s"} <= numbers
            for key in single:
                near = key in numbers and abs(row[key] - single[key]) < 1e-7
                assert near or row[key] == single[key]
