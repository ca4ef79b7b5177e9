"""A short form of the soak test in ``benchmarks/``: minutes in place of the hour."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

PATH = Path(__file__).parents[2] / "benchmarks" / "soak.py"


@pytest.fixture(scope="module")
def soak() -> ModuleType:
    spec = importlib.util.spec_from_file_location("soak", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["soak"] = module
    spec.loader.exec_module(module)
    return module


def test_a_run_with_many_faults_arrives_and_its_files_stay_small(
    soak: ModuleType, tmp_path: Path
) -> None:
    found = soak.soak_one(0.03, 0, tmp_path)
    assert found["arrived"], found["reason"]
    assert found["bytes_per_tick"] <= soak.MOST_BYTES_PER_TICK
    assert found["notes"] == []


def test_runs_with_faults_that_none_survives_end_as_runs_may(
    soak: ModuleType, tmp_path: Path
) -> None:
    # Of seed 2's six runs some arrive, one loses its features and one its line.
    found = soak.soak_many(0.03, 2, tmp_path)
    assert found["wrong"] == []
    assert set(found["ends"]) == {"reached", "lost", "fault"}
    assert (found["files_left_open"], found["threads_left"]) == (0, 0)
