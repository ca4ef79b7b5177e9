from __future__ import annotations

import time

import pytest

from visctrl.hal.clock import ManualClock, WallClock, WorldClock


class World:
    def __init__(self) -> None:
        self.steps: list[float] = []

    def advance(self, dt: float) -> None:
        self.steps.append(dt)


def test_a_lockstepped_world_moves_only_in_sleep_and_lands_on_the_deadline() -> None:
    world = World()
    clock = WorldClock(world.advance)
    assert clock.lockstep
    assert clock.synchronise() == 0.0
    for k in range(1, 4):
        clock.sleep_until(0.1 * k)
        assert clock.now() == 0.1 * k
    clock.sleep_until(0.05)
    assert clock.now() == pytest.approx(0.3), "it never goes back"
    assert world.steps == pytest.approx([0.1, 0.1, 0.1])


def test_a_world_that_follows_a_clock_is_brought_up_to_it_on_demand() -> None:
    world, wall = World(), ManualClock()
    clock = WorldClock(world.advance, wall)
    assert not clock.lockstep
    wall.advance(0.25)
    assert clock.now() == 0.25
    assert world.steps == [], "nobody has looked"
    assert clock.synchronise() == 0.25
    assert world.steps == [0.25]
    clock.sleep_until(1.0)
    assert world.steps == [0.25, 0.75]
    clock.synchronise()
    assert len(world.steps) == 2


def test_the_wall_clock_sleeps_and_never_wakes_early() -> None:
    clock = WallClock()
    began = time.monotonic()
    deadline = clock.now() + 0.05
    clock.sleep_until(deadline)
    assert clock.now() >= deadline
    assert time.monotonic() - began >= 0.05
    clock.sleep_until(0.0)
    assert time.monotonic() - began < 5.0
