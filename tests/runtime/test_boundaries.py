"""Numbers that are none, at every boundary of the tick: the robot recovers, or it stands."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visctrl.contracts import Estimate, Health, Views
from visctrl.hal.errors import BaseFaultError
from visctrl.hal.mock.backend import MockBackend
from visctrl.hal.types import STANDSTILL, Features, Frame, Odometry, Pose, Range, Velocity
from visctrl.runtime.boundaries import (
    check_odometry,
    sound_estimate,
    sound_frame,
    sound_ranges,
    sound_views,
)
from visctrl.runtime.config import load_scenario, parse_setting
from visctrl.runtime.plan import Plan, make_plan
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.session import Outcome, run_session
from visctrl.schemes.trifocal.estimate import TensorEstimate

SCHEMES = ("trifocal", "trifocal2d", "epipolar", "pose")
GARBAGE = (math.nan, math.inf, -math.inf)
#: What is spoilt, and whether the robot can go on for ever with it.
ONE_RAY, ALL_RAYS, PIXEL, SIGMA, ESTIMATE = "one ray", "all rays", "pixel", "sigma", "estimate"
DECISION, ODOMETRY, STAMP = "decision", "odometry", "stamp"
BEARABLE = {ONE_RAY, PIXEL}
#: A robot must stand so many ticks after the first bad one at the latest.
STOPPED_TICKS = 6


class Spoiler:
    """Spoils one kind of thing, in one tick or from it on for ever."""

    def __init__(self, what: str, value: float, first: int, lasting: bool, seed: int) -> None:
        self.what, self.value, self.first, self.lasting = what, value, first, lasting
        self.rng = np.random.default_rng(seed)
        self.calls = 0

    def due(self, what: str) -> bool:
        if what != self.what:
            return False
        self.calls += 1
        return self.calls > self.first and (self.lasting or self.calls == self.first + 1)

    def frame(self, frame: Frame) -> Frame:
        if self.due(STAMP):
            return frame._replace(stamp=self.value)
        if self.due(PIXEL) and frame.features is not None:
            pixels = frame.features.pixels.copy()
            pixels[self.rng.integers(len(pixels)), self.rng.integers(2)] = self.value
            return frame._replace(features=Features(frame.features.ids, pixels))
        return frame

    def views(self, views: Views) -> Views:
        name = str(self.rng.choice(["target", "initial", "current"]))
        if len(views) and self.due(ONE_RAY):
            rays = getattr(views, name).copy()
            rays[self.rng.integers(len(rays)), self.rng.integers(3)] = self.value
            return replace(views, **{name: rays})
        if self.due(ALL_RAYS):
            return replace(views, **{name: np.full_like(getattr(views, name), self.value)})
        return replace(views, sigma=self.value) if self.due(SIGMA) else views

    def estimate(self, estimate: Estimate, estimator: Any) -> Estimate:
        """Spoil what is given, and all that the estimator remembers in arrays or floats."""
        if not self.due(ESTIMATE):
            return estimate
        spoilt = {}
        for each in fields(estimate):
            value = getattr(estimate, each.name)
            if isinstance(value, float):
                spoilt[each.name] = math.nan
            elif isinstance(value, np.ndarray):
                spoilt[each.name] = np.full_like(value, self.value)
            elif hasattr(value, "_asdict"):
                numbers = {n: math.nan for n, v in value._asdict().items() if isinstance(v, float)}
                spoilt[each.name] = value._replace(**numbers)
        for name, value in vars(estimator).items():
            if isinstance(value, float):
                setattr(estimator, name, math.nan)
            elif isinstance(value, np.ndarray) and value.dtype.kind == "f":
                value[...] = math.nan
        return replace(estimate, **spoilt)


def spoilt_plan(scheme: str, spoiler: Spoiler) -> Plan:
    """Return a plan whose plugins and devices are spoilt."""
    texts = ("backend=mock", f"scheme={scheme}", "start.x_m=-0.3", "start.y_m=-1.2", "seed=3")
    overrides = [parse_setting(text) for text in (*texts, "approach.enabled=false")]
    if scheme == "pose":
        overrides.append(parse_setting("controller.tau_s=15"))
    plan = make_plan(load_scenario("default", overrides, REGISTRIES.backends.names()))
    perceiver: Any = plan.perception.cls
    estimator: Any = plan.main.estimator.cls
    controller: Any = plan.main.controller.cls

    class Perceiver(perceiver):
        def update(self, frame: Frame) -> Views:
            return spoiler.views(super().update(frame))

    class Locator(estimator):
        def update(self, views: Views, sent: Velocity, dt: float) -> Estimate:
            return spoiler.estimate(super().update(views, sent, dt), self)

    class Law(controller):
        def update(self, estimate: Any, sent: Velocity, dt: float) -> Any:
            decision = super().update(estimate, sent, dt)
            bad = spoiler.due(DECISION)
            return decision._replace(velocity=Velocity(0.1, spoiler.value)) if bad else decision

    class Robot(MockBackend):
        def open(self) -> None:
            super().open()
            read, odometry = self.camera.read, self.base.odometry
            self.camera.read = lambda: spoiler.frame(read())
            self.base.odometry = lambda: self.spoilt(odometry())

        def spoilt(self, odometry: Odometry) -> Odometry:
            bad = odometry.pose._replace(x=spoiler.value)
            return odometry._replace(pose=bad) if spoiler.due(ODOMETRY) else odometry

    main = replace(
        plan.main,
        estimator=replace(plan.main.estimator, cls=Locator),
        controller=replace(plan.main.controller, cls=Law),
    )
    perception = replace(plan.perception, cls=Perceiver)
    return replace(plan, backend=Robot, perception=perception, main=main)


class Ticks(Observer):
    def __init__(self) -> None:
        self.records: list[TickRecord] = []

    def on_tick(self, record: TickRecord) -> None:
        self.records.append(record)


def run(scheme: str, spoiler: Spoiler) -> tuple[Outcome, list[TickRecord]]:
    watcher = Ticks()
    return run_session(spoilt_plan(scheme, spoiler), observers=[watcher]), watcher.records


@pytest.mark.parametrize("scheme", SCHEMES)
@settings(max_examples=4)
@given(
    what=st.sampled_from([ONE_RAY, ALL_RAYS, PIXEL, SIGMA, ESTIMATE, DECISION, ODOMETRY, STAMP]),
    value=st.sampled_from(GARBAGE),
    first=st.integers(1, 60),
    lasting=st.booleans(),
    seed=st.integers(0, 99),
)
def test_it_recovers_or_stands(
    scheme: str, what: str, value: float, first: int, lasting: bool, seed: int
) -> None:
    outcome, records = run(scheme, Spoiler(what, value, first, lasting, seed))
    assert all(record.sent.finite for record in records)
    status = outcome.summary["status"]
    if what in (DECISION, ODOMETRY):
        assert (status, outcome.exit_code) == ("fault", 3)
        assert "not finite" in outcome.summary["reason"]
    elif lasting and what not in BEARABLE:
        assert status == "lost"
        for record in records[first + STOPPED_TICKS :]:
            assert record.sent == STANDSTILL
        assert any(word in outcome.summary["reason"] for word in ("finite", "number", "not a time"))
    else:
        assert status == "reached", outcome.summary["reason"]
        if what not in BEARABLE:
            assert any("held" in record.event for record in records)
    for record in records:
        if record.estimate.health is Health.LOST:
            assert record.sent == STANDSTILL, "never on garbage"


FLOATS = st.floats(allow_nan=True, allow_infinity=True, width=64)


@given(st.lists(st.lists(FLOATS, min_size=9, max_size=9), min_size=1, max_size=8), FLOATS)
def test_what_is_left_of_views_is_finite(rows: list[list[float]], sigma: float) -> None:
    rays = np.array(rows).reshape(-1, 3, 3)
    count = len(rays)
    views = Views(
        np.arange(count),
        *(rays[:, i] for i in range(3)),
        np.zeros((count, 2)),
        sigma,
        0.0,
        sigmas=lambda: rays[:, :, 0].T,
    )
    left, refused = sound_views(views)
    finite = np.isfinite(rays).all(axis=(1, 2))
    if left.health is Health.LOST:
        assert not finite.any() or not (math.isfinite(sigma) and sigma >= 0.0)
        assert refused == left.reason != ""
        return
    assert left.ids.tolist() == np.flatnonzero(finite).tolist()
    for array in (left.target, left.initial, left.current, left.pixels, left.bearing_sigmas()):
        assert np.isfinite(array).all()
    assert left.bearing_sigmas().shape == (3, len(left))


def tensor(**changes: Any) -> TensorEstimate:
    values = TensorEstimate(
        health=Health.OK,
        elements=np.ones(8),
        covariance=np.eye(8),
        phi_1=0.1,
        phi_1_sd=math.inf,
        scale_m=1.0,
        scale_sd_m=math.inf,
    )
    return replace(values, **changes)


def test_doubt_may_be_infinite_and_nothing_else() -> None:
    assert sound_estimate(tensor())[1]
    assert sound_estimate(tensor(covariance=np.diag([np.inf] * 8)))[1]
    for changes in (
        {"elements": np.array([1.0] * 7 + [math.nan])},
        {"elements": np.array([1.0] * 7 + [math.inf])},
        {"covariance": np.full((8, 8), math.nan)},
        {"scale_m": math.inf},
        {"phi_1_sd": math.nan},
    ):
        estimate, sound = sound_estimate(tensor(**changes))
        assert not sound
        assert estimate.health is Health.LOST
        assert next(iter(changes)) in estimate.reason


def test_a_frame_loses_the_features_that_are_nowhere() -> None:
    pixels = np.array([[1.0, 2.0], [math.nan, 2.0], [3.0, math.inf], [5.0, 6.0]])
    frame = sound_frame(Frame(0.0, 1, features=Features(np.array([1, 3, 5, 7]), pixels)))
    assert frame.features is not None
    assert frame.features.ids.tolist() == [1, 7]


def test_odometry_and_ranges() -> None:
    good = Odometry(1.0, Pose(0.0, 1.0, 2.0), STANDSTILL)
    check_odometry(good)
    for bad in (
        good._replace(stamp=math.nan),
        good._replace(pose=Pose(0.0, math.inf, 0.0)),
        good._replace(velocity=Velocity(0.0, math.nan)),
    ):
        with pytest.raises(BaseFaultError, match="not finite"):
            check_odometry(bad)
    nothing, broken = Range(0.0, 0.0, 0.0, math.inf), Range(0.0, 0.0, math.nan, 1.0)
    assert sound_ranges([nothing, broken]) == [nothing]
