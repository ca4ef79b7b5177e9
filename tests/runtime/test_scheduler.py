"""Deadlines on a clock that is moved by hand."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from visctrl.hal.clock import ManualClock
from visctrl.hal.interfaces import Clock
from visctrl.runtime.scheduler import GRACE, Tick, Ticker

PERIOD = 0.1


def run(works: list[float], clock: ManualClock | None = None) -> list[Tick]:
    """Return the ticks of a loop whose work takes so long each time."""
    clock = clock or ManualClock()
    ticker = Ticker(clock, PERIOD)
    ticks = []
    for work in works:
        ticks.append(ticker.wait())
        clock.advance(work)
    return ticks


def test_work_that_fits_keeps_every_deadline() -> None:
    ticks = run([0.03] * 5)
    assert [tick.start for tick in ticks] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert all(tick.missed == 0 and tick.lateness == 0.0 for tick in ticks)
    assert all(tick.dt == pytest.approx(PERIOD) for tick in ticks)


def test_a_stall_costs_whole_periods_and_keeps_the_phase() -> None:
    ticks = run([0.03, 0.25, 0.03, 0.03])
    # Work from 0.1 to 0.35: the deadlines 0.2 and 0.3 are given up, 0.4 is met.
    assert [tick.start for tick in ticks] == pytest.approx([0.0, 0.1, 0.4, 0.5])
    assert [tick.skipped for tick in ticks] == [0, 0, 2, 0]
    assert ticks[2].dt == pytest.approx(0.3)
    assert ticks[2].lateness == 0.0


def test_a_slight_overrun_is_served_late_instead_of_halving_the_rate() -> None:
    ticks = run([PERIOD * (1 + 0.5 * GRACE), 0.03, 0.03])
    assert ticks[1].skipped == 0
    assert ticks[1].lateness == pytest.approx(0.5 * GRACE * PERIOD)
    assert ticks[2].start == pytest.approx(0.2)


def test_oversleeping_is_blamed_on_nobody_and_keeps_the_phase() -> None:
    class Sleepy(ManualClock):
        def sleep_until(self, deadline: float) -> None:
            super().sleep_until(deadline)
            if math.isclose(deadline, 0.1):
                self.advance(0.23)

    ticks = run([0.03] * 4, Sleepy())
    assert [tick.start for tick in ticks] == pytest.approx([0.0, 0.33, 0.4, 0.5])
    assert [tick.overslept for tick in ticks] == [0, 2, 0, 0]
    assert ticks[1].lateness == pytest.approx(0.03)
    assert all(tick.skipped == 0 for tick in ticks)


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=50))
def test_every_deadline_is_met_or_counted(works: list[float]) -> None:
    """Ticks and given-up deadlines together are all the deadlines there were; none is early."""
    ticks = run([*works, 0.0])
    slots = 0
    for tick, work in zip(ticks, [0.0, *works], strict=True):
        slots += tick.missed
        deadline = slots * PERIOD
        assert tick.start - deadline == pytest.approx(tick.lateness, abs=1e-9)
        assert 0.0 <= tick.lateness <= GRACE * PERIOD + 1e-9
        assert tick.missed <= work / PERIOD + 1
        slots += 1


def test_the_origin_is_where_the_clock_stands() -> None:
    clock: Clock = ManualClock()
    clock.sleep_until(7.25)
    ticker = Ticker(clock, PERIOD)
    assert ticker.origin == 7.25
    assert ticker.wait().start == 7.25
    assert ticker.wait().start == pytest.approx(7.35)
