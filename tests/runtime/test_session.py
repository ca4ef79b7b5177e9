"""Whole runs on the mock: how they end, what the base was told last, what is left behind."""

from __future__ import annotations

import csv
import json
import math
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest
import yaml
from toy_plugins import SpyBackend, ToyController

from visctrl.contracts import Match
from visctrl.hal.actuation import Actuation
from visctrl.hal.clock import ManualClock
from visctrl.hal.errors import LinkError
from visctrl.hal.mock import backend as mock
from visctrl.hal.types import STANDSTILL, Frame, Velocity
from visctrl.robots.errors import InputError
from visctrl.runtime.plan import Plan
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.session import Outcome, run_session
from visctrl.viewers.run_pictures import run_with_pictures

MakePlan = Callable[..., Plan]

FILES = {
    *("config.yaml", "ticks.csv", "trajectory.tum", "summary.json"),
    *("target.png", "initial.png", "final.png", "report.html", ".visctrl-run"),
}


class Watcher(Observer):
    def __init__(self) -> None:
        self.records: list[TickRecord] = []
        self.initials: list[Frame] = []
        self.stages: list[str] = []

    def on_initial(self, frame: Frame, match: Match) -> None:
        self.initials.append(frame)

    def on_stage(self, stage: str) -> None:
        self.stages.append(stage)

    def on_tick(self, record: TickRecord) -> None:
        self.records.append(record)


def run(plan: Plan, out: Path | None = None) -> tuple[Outcome, SpyBackend, Watcher]:
    watcher = Watcher()
    if out is None:
        outcome = run_session(plan, observers=[watcher])
    else:
        outcome = run_with_pictures(plan, out, observers=[watcher])
    (backend,) = SpyBackend.opened
    return outcome, backend, watcher


def rows(out: Path) -> list[dict[str, str]]:
    with (out / "ticks.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def assert_stopped(backend: SpyBackend) -> None:
    """Hold that the base was told to stand still last and takes nothing any more."""
    assert backend.commands[-1][1] == STANDSTILL
    assert backend.closed >= 1
    with pytest.raises(LinkError, match="closed"):
        backend.base.stop()


# --- ends ------------------------------------------------------------------------------------


def test_a_run_that_finishes_on_the_target_is_reached(toy_plan: MakePlan, tmp_path: Path) -> None:
    out = tmp_path / "run"
    outcome, backend, watcher = run(toy_plan(), out)
    assert (outcome.summary["status"], outcome.exit_code) == ("reached", 0)
    error = outcome.summary["final_error"]
    assert math.hypot(error["x_m"], error["y_m"]) < 0.02
    assert outcome.summary["path_length_m"] == pytest.approx(1.0, abs=0.02)
    assert outcome.summary["ticks"] == len(watcher.records) == len(rows(out))
    assert {path.name for path in out.iterdir()} == FILES
    assert json.loads((out / "summary.json").read_text()) == outcome.summary
    assert_stopped(backend)


def test_summary_has_exactly_the_keys_that_are_promised(toy_plan: MakePlan) -> None:
    outcome, _, _ = run(toy_plan({"controller.drive_s": 0.5}))
    summary = outcome.summary
    assert list(summary) == [
        *("status", "reason", "backend", "scheme", "robot", "camera", "seed", "final_error"),
        *("arrival", "truth", "path_length_m", "duration_s", "period_s", "ticks"),
        *("missed_ticks", "lateness_ms"),
        *("compute_ms", "stages_ms", "real_time_factor", "features", "consistency"),
        "versions",
    ]
    assert set(summary["lateness_ms"]) == set(summary["compute_ms"]) == {"median", "p99", "max"}
    assert summary["period_s"] == 0.1


def test_signals_are_collected_where_somebody_reads_them(toy_plan: MakePlan) -> None:
    class Indifferent(Watcher):
        reads_signals: ClassVar[bool] = False

    indifferent, watcher = Indifferent(), Watcher()
    plan = toy_plan({"controller.drive_s": 0.5})
    run_session(plan, observers=[indifferent])
    assert {record.signals for record in indifferent.records} == {()}
    run_session(plan, observers=[indifferent, watcher])
    assert all(dict(record.signals)["toy"] for record in watcher.records)


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"controller.drive_s": 2.0}, "picture is not the target's"),
        ({"controller.finish": False, "duration_s": 3.0}, "not finished after 3"),
        (
            {"tolerance.position_m": 0.01, "controller.drive_s": 4.8},
            "picture is not the target's",
        ),
    ],
)
def test_ends_elsewhere_or_out_of_time_are_missed(
    toy_plan: MakePlan, settings: dict[str, Any], reason: str
) -> None:
    outcome, backend, _ = run(toy_plan(settings))
    assert (outcome.summary["status"], outcome.exit_code) == ("missed", 1)
    assert reason in outcome.summary["reason"]
    assert_stopped(backend)


def test_contacts_are_no_success(toy_plan: MakePlan, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SpyBackend, "collisions", lambda self: 3)
    outcome, _, _ = run(toy_plan())
    assert (outcome.summary["status"], outcome.exit_code) == ("missed", 1)
    assert "touched something (3 contacts)" in outcome.summary["reason"]


# --- faults ----------------------------------------------------------------------------------

FAULTS = {
    "plugin raises": ({"trouble": "raise"}, "fault", 3, "'toy' failed: ZeroDivisionError"),
    "not a number": ({"trouble": "nan"}, "fault", 3, "'toy': velocity is not finite"),
    "ctrl-c": ({"trouble": "interrupt"}, "stopped", 130, "Ctrl-C"),
    "sigint": ({"trouble": "sigint"}, "stopped", 130, "Ctrl-C"),
    "sigterm": ({"trouble": "sigterm"}, "stopped", 143, "SIGTERM"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_trouble_in_a_plugin_stops_the_base_and_leaves_the_files(
    toy_plan: MakePlan, tmp_path: Path, case: str
) -> None:
    trouble, status, code, reason = FAULTS[case]
    settings = {f"controller.{key}": value for key, value in trouble.items()}
    outcome, backend, watcher = run(toy_plan({**settings, "controller.at_s": 2.0}), tmp_path)
    assert (outcome.summary["status"], outcome.exit_code) == (status, code)
    assert reason in outcome.summary["reason"]
    assert backend.commands[-2][1].v == pytest.approx(0.2), "it was moving"
    assert_stopped(backend)
    assert len(watcher.records) == 20
    assert {path.name for path in tmp_path.iterdir()} >= FILES
    assert len(rows(tmp_path)) == 20
    if status == "fault":
        assert "Traceback" in (tmp_path / "fault.txt").read_text()


def test_a_second_signal_does_not_disturb_the_clean_up(
    toy_plan: MakePlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]

    def impatient(self: ToyController) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(ToyController, "close", impatient)
    plan = toy_plan({"controller.at_s": 2.0, "controller.trouble": "sigint"})
    outcome, backend, _ = run(plan, tmp_path)
    assert (outcome.summary["status"], outcome.exit_code) == ("stopped", 130)
    assert_stopped(backend)
    assert {path.name for path in tmp_path.iterdir()} == FILES
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_a_signal_waits_until_a_command_is_sent(
    toy_plan: MakePlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A command cut in two would leave half a packet on a serial line."""
    finished: list[Velocity] = []
    request = Actuation.request

    def interrupted(self: Actuation, t: float, velocity: Velocity) -> Velocity:
        if t > 1.0 and not finished:
            os.kill(os.getpid(), signal.SIGINT)
        sent = request(self, t, velocity)
        if t > 1.0:
            finished.append(sent)
        return sent

    monkeypatch.setattr(Actuation, "request", interrupted)
    outcome, backend, _ = run(toy_plan())
    assert outcome.summary["status"] == "stopped"
    assert finished[0].v > 0.0, "the command that the signal met was completed"
    assert_stopped(backend)


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"spy.faults.link_dead_s": [2.0, 1e6]}, "does not answer"),
        ({"spy.camera_dies_s": 2.0}, "the camera is gone"),
        ({"spy.base_fault_s": 2.0}, "left wheel stalled"),
        ({"spy.faults.camera_frozen_s": [2.0, 1e6]}, "the camera has frozen"),
    ],
)
def test_device_faults_end_the_run(
    toy_plan: MakePlan, tmp_path: Path, settings: dict[str, Any], reason: str
) -> None:
    outcome, backend, _ = run(toy_plan({**settings, "controller.drive_s": 30.0}), tmp_path)
    assert (outcome.summary["status"], outcome.exit_code) == ("fault", 3)
    assert reason in outcome.summary["reason"]
    assert backend.closed >= 1
    assert {path.name for path in tmp_path.iterdir()} >= FILES
    if "spy.faults.link_dead_s" in settings:
        assert any("could not be stopped" in note for note in outcome.notes)
    else:
        assert_stopped(backend)


def test_a_frozen_camera_stops_the_robot_long_before_it_is_a_fault(toy_plan: MakePlan) -> None:
    settings = {"spy.faults.camera_frozen_s": [2.0, 1e6], "controller.drive_s": 30.0}
    _, backend, _ = run(toy_plan({**settings, "safety.max_frame_age_s": 0.3}))
    moving = [t for t, sent in backend.commands if sent != STANDSTILL]
    assert 2.0 < max(moving) < 2.35
    assert max(t for t, _ in backend.commands) > 4.0


def test_darkness_holds_the_robot_and_ends_lost(toy_plan: MakePlan, tmp_path: Path) -> None:
    settings = {"spy.faults.camera_black_s": [2.0, 1e6], "safety.lost_timeout_s": 1.5}
    outcome, backend, watcher = run(toy_plan(settings), tmp_path)
    assert (outcome.summary["status"], outcome.exit_code) == ("lost", 1)
    assert "features lost for 1.5 s" in outcome.summary["reason"]
    assert all(sent == STANDSTILL for t, sent in backend.commands if t >= 2.0)
    assert [r.event.startswith("held") for r in watcher.records] == [
        r.t >= 1.95 for r in watcher.records
    ]
    assert_stopped(backend)


def test_after_a_blackout_the_run_goes_on_where_it_was(toy_plan: MakePlan) -> None:
    settings = {"spy.faults.camera_black_s": [2.0, 3.0], "tolerance.position_m": 0.05}
    outcome, backend, watcher = run(toy_plan(settings))
    assert (outcome.summary["status"], outcome.exit_code) == ("reached", 0)
    held = [record for record in watcher.records if record.event]
    assert len(held) == 10
    # The controller's time stood still with the robot: the drive is as long as without.
    assert outcome.summary["ticks"] == 51 + 10
    assert backend.commands[-1][1] == STANDSTILL


def test_dropped_frames_are_repeated_and_harmless(toy_plan: MakePlan) -> None:
    outcome, _, watcher = run(toy_plan({"spy.faults.frame_drop_probability": 0.3}))
    assert outcome.summary["status"] == "reached"
    sequences = [record.frame.sequence for record in watcher.records]
    assert len(set(sequences)) < len(sequences)


def test_bad_input_leaves_nothing_behind(toy_plan: MakePlan, tmp_path: Path) -> None:
    out = tmp_path / "new" / "run"
    settings = {"camera.name": "perspective", "start.phi_deg": 180.0}
    with pytest.raises(InputError, match="sees too little"):
        run_session(toy_plan(settings), out)
    assert not out.exists()
    with pytest.raises(InputError, match="60 features, 70 are needed"):
        run_session(toy_plan({"perception.min_features": 70}), out)
    assert not out.exists()
    (backend,) = SpyBackend.opened
    assert backend.closed >= 1
    assert all(sent == STANDSTILL for _, sent in backend.commands)


def test_a_fault_at_opening_is_an_outcome_too(
    toy_plan: MakePlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_port(self: SpyBackend) -> None:
        raise LinkError("/dev/ttyUSB7: no such port")

    monkeypatch.setattr(SpyBackend, "open", no_port)
    outcome = run_session(toy_plan(), tmp_path)
    assert (outcome.summary["status"], outcome.exit_code) == ("fault", 3)
    assert "/dev/ttyUSB7" in outcome.summary["reason"]
    assert outcome.summary["ticks"] == 0
    assert (tmp_path / "summary.json").is_file()


def test_a_session_may_run_outside_the_main_thread(toy_plan: MakePlan) -> None:
    plan, outcomes = toy_plan({"controller.drive_s": 2.0}), []
    thread = threading.Thread(target=lambda: outcomes.append(run_session(plan)))
    thread.start()
    thread.join()
    assert outcomes[0].summary["status"] == "missed"


# --- approach --------------------------------------------------------------------------------


def test_after_a_turn_the_initial_view_is_taken_again_at_rest(toy_plan: MakePlan) -> None:
    _, backend, watcher = run(toy_plan({"approach.enabled": True}))
    assert watcher.stages == ["approach", "main"]
    assert len(watcher.initials) == 2
    stages = [record.stage for record in watcher.records]
    assert stages == sorted(stages), "approach, then main"
    turned = watcher.records[stages.index("main")].truth
    assert turned is not None
    assert turned.phi == pytest.approx(0.18, abs=0.03)
    # Standing before the second view: half a second of ramp from 0.2 rad/s is over.
    last_turn = max(t for t, sent in backend.commands if sent.omega > 0)
    assert watcher.initials[1].stamp > last_turn + 0.2


def test_without_a_turn_the_initial_view_stays(toy_plan: MakePlan) -> None:
    settings = {"approach.enabled": True, "approach.controller.turn_s": 0.0}
    outcome, _, watcher = run(toy_plan(settings))
    assert watcher.stages == ["approach", "main"]
    assert len(watcher.initials) == 1
    assert outcome.summary["status"] == "reached"


def test_a_turn_that_does_not_end_is_missed(toy_plan: MakePlan) -> None:
    settings = {"approach.enabled": True, "approach.controller.turn_s": 99.0}
    outcome, backend, watcher = run(toy_plan({**settings, "approach.timeout_s": 2.0}))
    assert (outcome.summary["status"], outcome.exit_code) == ("missed", 1)
    assert "did not face the target after 2 s" in outcome.summary["reason"]
    assert watcher.stages == ["approach"]
    assert_stopped(backend)


# --- truth, determinism, time ------------------------------------------------------------------


def timeless(out: Path) -> list[dict[str, str]]:
    timing = ("lateness", "missed", "blame", "frame [ms]", "perception [ms]", "estimation")
    skip = (*timing, "control [ms]", "command [ms]")
    return [{k: v for k, v in row.items() if not k.startswith(skip)} for row in rows(out)]


def test_same_seed_same_bits_other_seed_other_bits(toy_plan: MakePlan, tmp_path: Path) -> None:
    settings = {"spy.noise_px": 0.5, "spy.faults.frame_drop_probability": 0.1}
    for name, seed in (("a", 7), ("b", 7), ("c", 8)):
        run_session(toy_plan({**settings, "seed": seed}), tmp_path / name)
    a, b, c = (timeless(tmp_path / name) for name in "abc")
    assert len(a) > 40
    assert a == b
    assert a != c


def test_the_truth_changes_nothing_but_what_is_told_of_it(
    toy_plan: MakePlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"spy.noise_px": 1.0, "approach.enabled": True}
    with_truth = run_session(toy_plan(settings))
    monkeypatch.setattr(SpyBackend, "truth", lambda self: None)
    outcome = run_session(toy_plan(settings))
    known, unknown = SpyBackend.opened
    assert known.commands == unknown.commands
    assert outcome.summary["final_error"] is outcome.summary["truth"] is None
    assert outcome.summary["status"] == with_truth.summary["status"] == "missed"
    assert outcome.summary["arrival"] == with_truth.summary["arrival"]


def test_a_stall_on_the_wall_clock_is_counted_blamed_and_keeps_the_phase(
    toy_plan: MakePlan, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    clock = ManualClock()
    monkeypatch.setattr(mock, "WallClock", lambda: clock)
    ToyController.sleep = staticmethod(clock.advance)
    trouble = {"controller.trouble": "stall", "controller.stall_s": 0.25, "controller.at_s": 2.0}
    outcome, _, watcher = run(toy_plan({**trouble, "realtime": True}), tmp_path)
    assert outcome.summary["missed_ticks"] == 2
    assert any("2 ticks missed" in note and "control 2" in note for note in outcome.notes)
    late = [record for record in watcher.records if record.tick.missed]
    assert [(record.tick.missed, record.blame) for record in late] == [(2, "control")]
    assert late[0].tick.dt == pytest.approx(0.3)
    phases = {round(record.t / 0.1, 6) % 1.0 for record in watcher.records}
    assert phases == {0.0}
    assert max(outcome.summary["stages_ms"]["control"].values()) == pytest.approx(250.0, abs=1.0)
    assert [row["missed"] for row in rows(tmp_path) if row["blame"] == "control"] == ["2"]


def test_a_long_stall_withdraws_the_command(
    toy_plan: MakePlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What comes out of a plugin that slept for a second must not reach the wheels."""
    clock = ManualClock()
    monkeypatch.setattr(mock, "WallClock", lambda: clock)
    ToyController.sleep = staticmethod(clock.advance)
    trouble = {"controller.trouble": "stall", "controller.stall_s": 1.0, "controller.at_s": 2.0}
    _, backend, watcher = run(toy_plan({**trouble, "realtime": True}))
    (held,) = (record for record in watcher.records if record.event)
    assert "grew old" in held.event
    assert held.sent == STANDSTILL
    assert STANDSTILL in [sent for t, sent in backend.commands if 2.9 < t < 3.1]


def test_effective_configuration_runs_again_identically(toy_plan: MakePlan, tmp_path: Path) -> None:
    run_session(toy_plan({"spy.noise_px": 0.5}), tmp_path / "a")
    data = yaml.safe_load((tmp_path / "a" / "config.yaml").read_text())
    again = toy_plan({key: value for key, value in data.items() if value is not None})
    run_session(again, tmp_path / "b")
    assert timeless(tmp_path / "a") == timeless(tmp_path / "b")
