"""The closed loop without pictures: runs on the mock, in one process and in two."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import pytest
from paired import ADDITIONS, additions, paired
from two_cores import machine_ratio

from visctrl.runtime.config import load_scenario, parse_setting
from visctrl.runtime.interrupts import Interrupts
from visctrl.runtime.plan import make_plan
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.session import run_session
from visctrl.studies.batch import drive, run_all
from visctrl.studies.loading import load_study
from visctrl.studies.log import StudyLog
from visctrl.studies.run_spec import RunSpec
from visctrl.studies.runner import run_study, table_rows
from visctrl.studies.table import Row, write_table
from visctrl.studies.workers import Results

T = TypeVar("T")
R = TypeVar("R")

ROUNDS = 7
#: Runs of a small study, and how often it is made in two processes and in one.
JOBS, STUDIES = 100, 3


def measured(benchmark: Any, *settings: str, bound: str = "") -> None:
    """Time whole runs of the mock scenario."""
    changes = [parse_setting(text) for text in settings]
    plan = make_plan(load_scenario("mock", changes, REGISTRIES.backends.names()))
    simulated, ticks = [], []

    def run() -> None:
        summary = run_session(plan).summary
        assert summary["ticks"] > 0
        simulated.append(summary["duration_s"])
        ticks.append(summary["ticks"])

    paired(
        benchmark,
        run,
        additions,
        rounds=ROUNDS,
        against=f"{ADDITIONS} array additions",
        bound=bound,
    )
    took = benchmark.stats.stats.median
    benchmark.extra_info["notes"] = {
        "x real time": f"{simulated[-1] / took:.0f}",
        "ticks/s": f"{ticks[-1] / took:.0f}",
        "additions a tick": f"{benchmark.extra_info['ratio'] * ADDITIONS / ticks[-1]:.0f}",
    }


@pytest.mark.parametrize("scheme", ["trifocal", "epipolar", "pose"])
def test_run(benchmark: Any, scheme: str) -> None:
    """One run of the default task, opening and teaching included."""
    measured(benchmark, f"scheme={scheme}", bound="300 x real time")


@pytest.mark.parametrize("features", [10, 100, 1000])
def test_run_by_features(benchmark: Any, features: int) -> None:
    """The trifocal run with few and with many features."""
    measured(benchmark, f"mock.features={features}")


def test_two_processes(benchmark: Any) -> None:
    """A small study in two processes against the same in one; wall time, start included."""
    jobs = [RunSpec("mock", (f"seed={seed}",)) for seed in range(JOBS)]

    took: dict[int, list[float]] = {1: [], 2: []}

    def study(workers: int) -> None:
        began = time.perf_counter()
        run_all(jobs, workers, lambda index, summary: None, drive)
        took[workers].append(time.perf_counter() - began)

    benchmark.pedantic(lambda: study(2), setup=lambda: study(1), rounds=STUDIES)
    ratio = statistics.median(two / one for one, two in zip(took[1], took[2], strict=True))
    benchmark.extra_info.update(
        against=f"the same {JOBS} runs in one process",
        reference_ms=1e3 * statistics.median(took[1]),
        ratio=ratio,
        bound="1 / 1.8",
        ms=1e3 * statistics.median(took[2]),
        notes={
            "wall time, quicker": f"{1.0 / ratio:.2f} x",
            "work that shares nothing": f"{1.0 / machine_ratio():.2f} x",
        },
    )


class _Here:
    """Works in this process, whose time is what is measured."""

    count = 1

    def each(self, work: Callable[[T], R], items: Iterable[T]) -> Results[T, R]:
        for item in items:
            yield item, work(item)


@pytest.mark.parametrize("name", ["far-starts", "noise"])
def test_study(benchmark: Any, name: str, tmp_path: Path) -> None:
    """A shipped study of trifocal runs with one worker: checks, runs, log and table."""
    rows: list[Row] = []

    def run() -> None:
        study = load_study(name)
        study.check()
        folder = tmp_path / str(time.perf_counter_ns())
        with StudyLog(folder) as log, Interrupts() as interrupts:
            run_study(study, log, _Here(), interrupts)
            rows[:] = table_rows(study, log, {})
            write_table(rows, folder)

    paired(benchmark, run, additions, rounds=1, against=f"{ADDITIONS} array additions")
    simulated = sum(row["time_s"] for row in rows)
    benchmark.extra_info["notes"] = {
        "runs": str(len(rows)),
        "x real time": f"{simulated / benchmark.stats.stats.median:.0f}",
    }
