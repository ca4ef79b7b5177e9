"""A camera that shows the past is found out; a robot that stands, creeps or looks far is not."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visctrl.contracts import Views
from visctrl.hal.mock.backend import MockBackend
from visctrl.hal.types import STANDSTILL, Features, Frame, Odometry, Pose, Velocity
from visctrl.robots.unicycle import along_arc
from visctrl.runtime.config import load_scenario, parse_setting
from visctrl.runtime.image_motion import ImageMotion
from visctrl.runtime.plan import make_plan
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.session import run_session

PERIOD, ROWS, SIGMA = 0.1, 480, 1.5e-3


class World:
    """Points round a robot that follows its commands exactly, seen with noise; it may freeze.

    torn : only the lower half of the image freezes.
    lag : the image is of so many ticks ago.
    """

    def __init__(self, distance: float, seed: int, field: float = math.pi, lag: int = 0) -> None:
        rng = self.rng = np.random.default_rng(seed)
        bearing = rng.uniform(-field, field, 80)
        far = distance * rng.uniform(0.5, 1.5, 80)
        height = far * rng.uniform(-0.4, 0.4, 80)
        self.points = np.stack([far * np.sin(bearing), far * np.cos(bearing), height], axis=1)
        self.rows = rng.uniform(0.0, ROWS, 80)
        self.pose, self.t, self.lag = (0.0, 0.0, 0.0), 0.0, lag
        self.past = [self._exact()]
        self.motion = ImageMotion(ROWS)

    def _exact(self) -> np.ndarray:
        x, y, phi = self.pose
        right, forward = self.points[:, 0] - x, self.points[:, 1] - y
        s, c = math.sin(phi), math.cos(phi)
        seen = np.stack(
            [c * right + s * forward, c * forward - s * right, self.points[:, 2]], axis=1
        )
        return seen / np.linalg.norm(seen, axis=1, keepdims=True)

    def tick(self, velocity: Velocity, frozen: str = "") -> str:
        self.pose = along_arc(self.pose, velocity, PERIOD)
        self.t += PERIOD
        shown = self.past[-1]
        fresh = self._exact()
        if not frozen:
            shown = fresh
        elif frozen == "torn":
            shown = np.where((self.rows < ROWS / 2)[:, None], fresh, shown)
        self.past.append(shown)
        rays = self.past[max(-1 - self.lag, -len(self.past))]
        rays = rays + self.rng.normal(scale=SIGMA, size=rays.shape)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        pixels = np.stack([np.zeros(80), self.rows], axis=1)
        views = Views(np.arange(80), rays, rays, rays, pixels, SIGMA, self.t)
        return self.motion.judge(views, Odometry(self.t, Pose(*self.pose), velocity))

    def first_verdict(self, velocity: Velocity, seconds: float, frozen: str = "") -> float | None:
        """Return after how long (s) the picture was found to be old."""
        for k in range(round(seconds / PERIOD)):
            if self.tick(velocity, frozen):
                return (k + 1) * PERIOD
        return None


@pytest.mark.parametrize("frozen", ["frozen", "torn"])
@settings(max_examples=15)
@given(
    omega=st.floats(0.15, 0.8),
    side=st.sampled_from([-1, 1]),
    seed=st.integers(0, 999),
    v=st.floats(0.0, 0.2),
    field=st.sampled_from([0.6, math.pi]),
)
def test_a_picture_that_does_not_turn_with_the_robot(
    frozen: str, omega: float, side: int, seed: int, v: float, field: float
) -> None:
    world = World(4.0, seed, field)
    turning = Velocity(v, side * omega)
    assert world.first_verdict(turning, 1.0) is None
    found = world.first_verdict(turning, 2.0, frozen)
    assert found is not None
    assert found <= 0.6


@pytest.mark.parametrize("frozen", ["frozen", "torn"])
@settings(max_examples=15)
@given(v=st.floats(0.15, 0.4), seed=st.integers(0, 999), distance=st.floats(1.5, 5.0))
def test_a_picture_that_does_not_come_with_the_robot(
    frozen: str, v: float, seed: int, distance: float
) -> None:
    world = World(distance, seed)
    assert world.first_verdict(Velocity(v, 0.0), 1.5) is None
    found = world.first_verdict(Velocity(v, 0.0), 2.0, frozen)
    assert found is not None
    assert found <= 1.0


@settings(max_examples=40)
@given(
    distance=st.floats(1.5, 1000.0),
    v=st.floats(-0.4, 0.4),
    omega=st.floats(-0.8, 0.8),
    field=st.sampled_from([0.5, math.pi]),
    lag=st.integers(0, 2),
    seed=st.integers(0, 999),
)
def test_a_picture_of_the_present_is_never_taken_for_an_old_one(
    distance: float, v: float, omega: float, field: float, lag: int, seed: int
) -> None:
    """Standing, creeping, starting, stopping and turning back; near scenes and far ones."""
    world = World(distance, seed, field, lag)
    still = (STANDSTILL,) * 8
    slow = Velocity(0.05 * v, 0.05 * omega)
    legs = (Velocity(v, 0.0), Velocity(0.0, omega), Velocity(0.3 * v, omega), slow)
    for leg in legs:
        for velocity in (*still, *(leg,) * 8):
            assert world.tick(velocity) == ""


@pytest.mark.parametrize("frozen", ["", "torn", "whole"])
def test_on_an_arc_things_at_its_middle_hold_their_bearing(frozen: str) -> None:
    """Turning by v/r, what lies r beside the robot does not move in the image but for depth."""
    velocity = Velocity(0.4, 0.2)
    world = World(2.0, seed=3)
    rng = np.random.default_rng(4)
    beside, far = rng.uniform(-0.45, 0.45, 80) - math.pi / 2, rng.uniform(1.6, 2.4, 80)
    world.points[:, 0], world.points[:, 1] = far * np.sin(beside), far * np.cos(beside)
    world.past = [world._exact()]
    found = world.first_verdict(velocity, 1.2, frozen)
    if frozen:
        assert found is not None
        assert found <= 1.0
    else:
        assert found is None


def test_a_frozen_picture_of_a_robot_that_stands_or_looks_far_is_no_verdict() -> None:
    world = World(4.0, 1)
    assert world.first_verdict(STANDSTILL, 3.0, "frozen") is None
    far = World(1000.0, 1)
    assert far.first_verdict(Velocity(0.3, 0.0), 3.0) is None
    assert far.first_verdict(Velocity(0.3, 0.0), 3.0, "frozen") is None


class Ticks(Observer):
    def __init__(self) -> None:
        self.records: list[TickRecord] = []

    def on_tick(self, record: TickRecord) -> None:
        self.records.append(record)


class Freezer(MockBackend):
    """Its camera repeats one picture from 3 s on, with new noise, stamps and numbers."""

    def open(self) -> None:
        super().open()
        read, rng, kept = self.camera.read, np.random.default_rng(0), [None]

        def frozen() -> Frame:
            frame = read()
            assert frame.features is not None
            if frame.stamp < 3.0 or kept[0] is None:
                kept[0] = frame.features
                return frame
            pixels = kept[0].pixels + rng.normal(scale=0.3, size=kept[0].pixels.shape)
            return frame._replace(features=Features(kept[0].ids, pixels))

        self.camera.read = frozen


@pytest.mark.parametrize("scheme", ["trifocal", "epipolar", "pose"])
def test_a_run_with_a_frozen_camera_stops_at_once(scheme: str) -> None:
    texts = ("backend=mock", f"scheme={scheme}", "start.x_m=-0.5", "start.y_m=-2", "seed=3")
    overrides = [parse_setting(text) for text in (*texts, "approach.enabled=false")]
    plan: Any = make_plan(load_scenario("default", overrides, REGISTRIES.backends.names()))
    watcher = Ticks()
    outcome = run_session(replace(plan, backend=Freezer), observers=[watcher])
    assert outcome.exit_code == 3
    assert "the camera shows the past" in outcome.summary["reason"]
    old = [record for record in watcher.records if record.t >= 3.0]
    way = math.dist(old[0].odometry.pose[:2], old[-1].odometry.pose[:2])
    assert old[-1].t - 3.0 <= 1.0 or way < 0.2, "a slow robot may take longer, not farther"
