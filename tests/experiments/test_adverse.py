"""The cells of ``visctrl reproduce adverse``, and how their runs are judged; none is driven."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import pytest

from visctrl.reproduce import adverse
from visctrl.reproduce.adverse import Run, planned
from visctrl.reproduce.adverse_cells import MACHINES, Cell, cells
from visctrl.studies.run_spec import RunSpec


def test_every_run_of_the_table_can_be_planned() -> None:
    for run in planned(1):
        plan = run.spec.plan()
        assert plan.scenario.scheme == run.scheme


def test_a_cell_is_driven_with_every_scheme_and_every_machine() -> None:
    runs = planned(2 * len(MACHINES))
    assert len({run.spec.key for run in runs}) == len(runs)
    assert len(runs) == 2 * len(MACHINES) * len(cells()) * len(adverse.SCHEMES)
    hall = [run.spec.settings[1:4] for run in runs if run.cell.name == "hall"]
    assert set(Counter(hall).values()) == {2 * len(adverse.SCHEMES)}


def test_more_runs_keep_those_there_were() -> None:
    few, more = planned(1), planned(3)
    assert [run.spec for run in few] == [run.spec for run in more[: len(few)]]


def test_schemes_of_a_run_differ_in_nothing_else() -> None:
    for one, other in zip(planned(2)[0::3], planned(2)[1::3], strict=True):
        assert one.spec.settings[1:] == other.spec.settings[1:]


def ended(status: str, cm: float | None, deg: float = 0.0, reason: str = "") -> tuple[Run, Any]:
    run = Run(Cell("a"), "pose", 100.0, RunSpec("default"))
    return run, {"status": status, "reason": reason, "distance_cm": cm, "phi_deg": deg}


@pytest.mark.parametrize(
    ("runs", "counts"),
    [
        ([ended("reached", 0.4)], {"success": 1, "median cm": 0.4}),
        ([ended("reached", 2.1)], {"FALSE SUCCESS": 1, "worst cm": 2.1}),
        ([ended("reached", 0.1, -1.2)], {"FALSE SUCCESS": 1, "worst deg": 1.2}),
        ([ended("missed", 30.0, reason="touched something")], {"missed": 1, "contacts": 1}),
        ([ended("missed", 151.0)], {"missed": 1, "away": 1}),
        ([ended("refused", None)], {"refused": 1}),
        ([ended("doubtful", 40.0)], {"doubtful": 1}),
    ],
)
def test_what_a_run_counts_as(runs: list[Any], counts: dict[str, float]) -> None:
    row = adverse._row(Cell("a"), "pose", runs)
    shown = {k: v for k, v in row.ours.items() if k != "runs" and v and not math.isnan(v)}
    for key, value in counts.items():
        assert shown[key] == pytest.approx(value)
    unheard = {"success", "FALSE SUCCESS", "doubtful", "refused", "missed", "contacts", "away"}
    assert not (shown.keys() & unheard) - counts.keys()
    bad = {"FALSE SUCCESS", "contacts", "away"} & counts.keys()
    assert row.ok == (not bad)
