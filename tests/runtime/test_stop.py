"""A stop that another thread asks for."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import pytest
from toy_plugins import SpyBackend, ToyController

from visctrl.hal.types import STANDSTILL
from visctrl.runtime.plan import Plan
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.session import run_session
from visctrl.runtime.stop import StopRequest, StopRequested


class StopsAt(Observer):
    """Asks for a stop right after a tick."""

    def __init__(self, stop: StopRequest, number: int) -> None:
        self.stop, self.number = stop, number

    def on_tick(self, record: TickRecord) -> None:
        if record.number == self.number:
            asking = threading.Thread(target=self.stop.make, args=("stopped by a test",))
            asking.start()
            asking.join()


def test_no_command_follows_a_stop(toy_plan: Callable[..., Plan]) -> None:
    stop = StopRequest()
    outcome = run_session(toy_plan(), observers=[StopsAt(stop, 7)], stop=stop)
    assert (outcome.summary["status"], outcome.exit_code) == ("stopped", 130)
    assert outcome.summary["reason"] == "stopped by a test"
    assert outcome.summary["ticks"] == 8
    (backend,) = SpyBackend.opened
    moving = [t for t, sent in backend.commands if sent != STANDSTILL]
    last, sent = backend.commands[-1]
    assert sent == STANDSTILL
    assert last - max(moving) <= 0.1 + 1e-9, "one tick"


def test_a_stop_asked_for_early_keeps_the_robot_where_it_is(toy_plan: Callable[..., Plan]) -> None:
    stop = StopRequest()
    stop.make("first")
    stop.make("second")
    outcome = run_session(toy_plan(), stop=stop)
    assert outcome.summary["reason"] == "first"
    (backend,) = SpyBackend.opened
    assert all(sent == STANDSTILL for _, sent in backend.commands)


def test_a_stop_reaches_the_base_while_a_plugin_hangs(toy_plan: Callable[..., Plan]) -> None:
    """On the wall clock nobody waits for the plugin: it may never come back."""
    stop = StopRequest()
    hanging, stopped_at = threading.Event(), []

    def hang(seconds: float) -> None:
        hanging.set()
        time.sleep(seconds)

    ToyController.sleep = staticmethod(hang)

    def ask() -> None:
        hanging.wait()
        stop.make("stopped by a test")
        (backend,) = SpyBackend.opened
        stopped_at.append((backend.clock.now(), backend.commands[-1][1]))

    asking = threading.Thread(target=ask)
    asking.start()
    settings = {"controller.trouble": "stall", "controller.stall_s": 0.8, "controller.at_s": 0.2}
    plan = toy_plan({**settings, "safety.max_command_age_s": 10.0, "realtime": True})
    outcome = run_session(plan, stop=stop)
    asking.join()
    (backend,) = SpyBackend.opened
    (when, sent) = stopped_at[0]
    assert sent == STANDSTILL, "before the request returned"
    assert all(sent == STANDSTILL for t, sent in backend.commands if t >= when)
    assert outcome.summary["status"] == "stopped"


def test_the_thread_that_asks_hears_nothing_of_a_failing_base() -> None:
    stop = StopRequest()

    def fail() -> None:
        raise OSError("gone")

    with stop.acting_at_once(fail):
        stop.make("stopped")
    with pytest.raises(StopRequested, match="stopped"):
        stop.check()
