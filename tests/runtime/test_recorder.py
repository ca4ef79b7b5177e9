"""Logs that can be read, whatever happens to the disk or the process."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from toy_plugins import SpyBackend

from visctrl.robots.errors import InputError
from visctrl.runtime.plan import Plan
from visctrl.runtime.recorder import Recorder
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.session import run_session
from visctrl.viewers.report.ticks import read_ticks

MakePlan = Callable[..., Plan]


class Keep(Observer):
    def __init__(self) -> None:
        self.records: list[TickRecord] = []

    def on_tick(self, record: TickRecord) -> None:
        self.records.append(record)


@pytest.fixture
def recorded(toy_plan: MakePlan, tmp_path: Path) -> tuple[Path, list[TickRecord]]:
    keep = Keep()
    settings = {"start.x_m": 0.2, "start.phi_deg": 10.0, "controller.omega": 0.1}
    run_session(toy_plan(settings), tmp_path / "run", observers=[keep])
    return tmp_path / "run", keep.records


def test_every_signal_of_every_tick_is_a_column_with_its_unit(
    recorded: tuple[Path, list[TickRecord]],
) -> None:
    directory, records = recorded
    with (directory / "ticks.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(records)
    for row, record in zip(rows, records, strict=True):
        assert record.truth is not None
        assert float(row["t [s]"]) == record.t
        assert row["phase"] == record.decision.phase
        assert float(row["x_true [m]"]) == record.truth.x
        assert float(row["v_wanted [m/s]"]) == record.decision.velocity.v
        assert float(row["omega_sent [rad/s]"]) == record.sent.omega
        assert float(row["battery [V]"]) == 12.5
        values = dict(record.signals)
        assert set(values) == {"toy"}
        assert row["estimate_health"] == "ok"
    assert "toy.distance [m]" in rows[0]
    assert "toy.left [s]" in rows[0]
    assert float(rows[-1]["toy.distance [m]"]) == pytest.approx(0.94, abs=0.03)


def test_the_trajectory_is_in_rep_103_axes(recorded: tuple[Path, list[TickRecord]]) -> None:
    directory, records = recorded
    table = np.loadtxt(directory / "trajectory.tum")
    assert table.shape == (len(records), 8)
    for row, record in zip(table, records, strict=True):
        assert record.truth is not None
        x, y, phi = record.truth
        assert row[0] == pytest.approx(record.t, abs=1e-6)
        assert row[1:4] == pytest.approx((y, -x, 0.0), abs=1e-8)
        assert row[4:6] == pytest.approx((0.0, 0.0))
        assert 2 * math.atan2(row[6], row[7]) == pytest.approx(phi, abs=1e-8)


def test_a_log_cut_short_by_a_crash_can_still_be_read(
    recorded: tuple[Path, list[TickRecord]], tmp_path: Path
) -> None:
    directory, records = recorded
    text = (directory / "ticks.csv").read_text()
    (tmp_path / "ticks.csv").write_text(text[: int(0.6 * len(text))])
    ticks = read_ticks(tmp_path / "ticks.csv")
    assert 0.4 * len(records) < len(ticks) < 0.8 * len(records)
    assert ticks.units["x_true"] == "m"
    assert ticks.words["stage"] == ["main"] * len(ticks)
    header = text.splitlines()[0]
    (tmp_path / "ticks.csv").write_text(header + "\n")
    assert len(read_ticks(tmp_path / "ticks.csv")) == 0


def test_files_that_are_no_tick_logs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_ticks(tmp_path / "ticks.csv")
    (tmp_path / "ticks.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="not a tick log"):
        read_ticks(tmp_path / "ticks.csv")
    (tmp_path / "ticks.csv").write_text("")
    with pytest.raises(InputError, match="not a tick log"):
        read_ticks(tmp_path / "ticks.csv")


@pytest.mark.parametrize("realtime", [False, True])
def test_a_full_disk_ends_the_run_with_the_robot_standing(
    toy_plan: MakePlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, realtime: bool
) -> None:
    written = 0

    def full(self: Recorder, record: TickRecord) -> None:
        nonlocal written
        written += 1
        if written > 5:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(Recorder, "_write", full)
    outcome = run_session(toy_plan({"realtime": realtime}), tmp_path / "run")
    assert outcome.exit_code == 3
    assert outcome.summary["status"] == "fault"
    assert "No space left" in outcome.summary["reason"]
    assert (tmp_path / "run" / "summary.json").exists()
    (backend,) = SpyBackend.opened
    assert backend.closed == 1
    assert len(backend.commands) <= 8, "it is stopped at once"
