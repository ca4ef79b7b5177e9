"""The mock on the wall clock. The long form is asked for: ``VISCTRL_WALL_CLOCK_S=60 pytest``."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable

import pytest
from toy_plugins import SpyBackend

from visctrl.hal.errors import LinkError
from visctrl.hal.types import STANDSTILL
from visctrl.runtime import overdue
from visctrl.runtime.plan import Plan
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.session import run_session
from visctrl.runtime.watchdog import Watchdog


def test_ticks_keep_their_deadlines(toy_plan: Callable[..., Plan]) -> None:
    """Loose bounds in the short form: the machine may be doing other things."""
    seconds = float(os.environ.get("VISCTRL_WALL_CLOCK_S", "2"))
    settings = {"controller.drive_s": seconds, "duration_s": seconds + 5.0, "controller.v": 0.01}
    outcome = run_session(toy_plan({**settings, "realtime": True}))
    summary = outcome.summary
    # The frames by which arrival is judged come after the last tick.
    assert seconds - 0.2 <= summary["duration_s"] <= seconds + 1.5
    assert summary["real_time_factor"] == pytest.approx(1.0, abs=0.02)
    lateness = summary["lateness_ms"]
    print(f"\nlateness ms {lateness}, missed {summary['missed_ticks']}, {outcome.notes}")
    if seconds >= 30.0:
        assert summary["missed_ticks"] == 0
        assert lateness["p99"] <= 5.0
    else:
        assert lateness["median"] <= 10.0
        assert summary["ticks"] >= 0.8 * 10 * seconds


class Intervals(Observer):
    """Notes how long a thread may keep the interpreter, in every tick."""

    def __init__(self) -> None:
        self.seen: set[float] = set()

    def on_tick(self, record: TickRecord) -> None:
        self.seen.add(sys.getswitchinterval())


@pytest.mark.parametrize("realtime", [True, False])
def test_threads_are_prompt_where_time_runs(toy_plan: Callable[..., Plan], realtime: bool) -> None:
    intervals, before = Intervals(), sys.getswitchinterval()
    run_session(toy_plan({"controller.drive_s": 0.3, "realtime": realtime}), observers=[intervals])
    (seen,) = intervals.seen
    assert seen <= 0.001 if realtime else seen == before
    assert sys.getswitchinterval() == before


def test_the_robot_is_stopped_while_a_plugin_hangs(toy_plan: Callable[..., Plan]) -> None:
    """Not when it comes back: nobody knows whether it ever will."""
    trouble = {"controller.trouble": "stall", "controller.stall_s": 1.5, "controller.at_s": 0.3}
    limits = {"safety.max_command_age_s": 0.4, "controller.drive_s": 0.6}
    run_session(toy_plan({**trouble, **limits, "realtime": True}))
    (backend,) = SpyBackend.opened
    moving = [t for t, sent in backend.commands if sent != STANDSTILL]
    before = max(t for t in moving if t < 1.0)
    stopped = min(t for t, sent in backend.commands if sent == STANDSTILL and t > before)
    assert 0.3 < stopped - before < 1.2, "0.4 s after the last command, long before 1.5 s"


@pytest.mark.parametrize("realtime", [True, False])
def test_a_plugin_that_never_returns_ends_the_run(
    toy_plan: Callable[..., Plan], realtime: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its name, as a fault, some time after the run should have been over."""
    monkeypatch.setattr(overdue, "GRACE_S", 0.5)
    trouble = {"controller.trouble": "stall", "controller.stall_s": 600.0, "controller.at_s": 0.2}
    began = time.monotonic()
    outcome = run_session(toy_plan({**trouble, "duration_s": 1.0, "realtime": realtime}))
    assert time.monotonic() - began < 60.0
    assert outcome.exit_code == 3
    assert outcome.summary["status"] == "fault"
    assert outcome.summary["reason"].startswith("controller '")
    assert "does not return" in outcome.summary["reason"]
    (backend,) = SpyBackend.opened
    assert backend.closed
    assert backend.base.odometry().velocity == STANDSTILL


@pytest.mark.parametrize("realtime", [True, False])
def test_a_slow_plugin_is_no_fault(
    toy_plan: Callable[..., Plan], realtime: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beyond the end of its stage, but not for longer than the grace."""
    monkeypatch.setattr(overdue, "GRACE_S", 30.0)
    trouble = {"controller.trouble": "stall", "controller.stall_s": 1.0, "controller.at_s": 0.2}
    outcome = run_session(toy_plan({**trouble, "duration_s": 0.5, "realtime": realtime}))
    assert outcome.summary["status"] != "fault"
    assert outcome.exit_code != 3


def test_a_watchdog_leaves_a_fed_or_standing_robot_alone() -> None:
    stops: list[float] = []
    with Watchdog(lambda: stops.append(time.monotonic()), 0.3) as watchdog:
        for _ in range(6):
            watchdog.feed(moving=True)
            time.sleep(0.05)
        watchdog.feed(moving=False)
        time.sleep(0.4)
        assert stops == []
        watchdog.feed(moving=True)
        time.sleep(0.8)
        assert len(stops) == 1, "once is enough"


def test_a_watchdog_survives_a_base_that_fails() -> None:
    def fail() -> None:
        raise LinkError("gone")

    with Watchdog(fail, 0.05) as watchdog:
        watchdog.feed(moving=True)
        time.sleep(0.2)
        watchdog.feed(moving=False)
