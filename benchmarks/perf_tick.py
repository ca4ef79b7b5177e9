"""A tick of each scheme on rendered frames, against the Lucas–Kanade calls it cannot do without."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from functools import cache
from typing import Any

import cv2
import pytest
from bench_tick import PERIOD_S, VELOCITY, bare_tracking, drive
from paired import paired

from visctrl.contracts import Controller, Estimator
from visctrl.hal.types import Frame
from visctrl.perception.klt import Klt
from visctrl.runtime.config import load_scenario, parse_setting
from visctrl.runtime.plan import Plan, make_plan
from visctrl.runtime.registry import REGISTRIES

FRAMES, FEATURES = 25, 100
STAGES = ("perception", "estimation", "control")


class Ticks:
    """The plugins of a scheme, fed with one rendered frame after the other."""

    def __init__(self, plan: Plan, target: list[Frame], frames: list[Frame]) -> None:
        context = plan.context(lockstep=True)
        options = plan.perception.options.model_copy(update={"max_features": FEATURES})
        self.klt = Klt(options, context)  # type: ignore[arg-type]
        self.estimator: Estimator[Any, Any] = plan.main.estimator.build(context)
        self.controller: Controller[Any, Any] = plan.main.controller.build(context)
        self.klt.set_target(target)
        self.klt.set_initial(frames[0])
        self.estimator.reset()
        self.previous, self._frames = frames[0], iter(frames[1:])
        self.seconds: dict[str, list[float]] = {name: [] for name in STAGES}
        self._advance()

    def _advance(self) -> None:
        self.views = self.klt.update(self.previous)
        self.current = next(self._frames)

    def bare(self) -> None:
        """Track there and back between the two frames, as OpenCV offers it."""
        bare_tracking(self.previous, self.current, self.views.pixels)

    def stages(self) -> Iterator[str]:
        """Do one tick, pausing before its first stage and after each."""
        yield "begin"
        self.views = self.klt.update(self.current)
        yield "perception"
        estimate = self.estimator.update(self.views, VELOCITY, PERIOD_S)
        yield "estimation"
        self.controller.update(estimate, VELOCITY, PERIOD_S)
        yield "control"

    def tick(self) -> None:
        """Do one tick and note what its stages took."""
        before = 0.0
        for stage in self.stages():
            now = time.process_time()
            if stage in self.seconds:
                self.seconds[stage].append(now - before)
            before = now
        self.previous, self.current = self.current, next(self._frames, self.current)


@cache
def rendered(camera: Any) -> tuple[list[Frame], list[Frame]]:
    """Return the target frames and those of a short drive, rendered once."""
    return drive(camera, FRAMES + 3)


def plan_of(scheme: str, *settings: str) -> Plan:
    """Return the default scenario with another scheme."""
    changes = [parse_setting(text) for text in (f"scheme={scheme}", *settings)]
    return make_plan(load_scenario("default", changes, REGISTRIES.backends.names()))


def measured(benchmark: Any, plan: Plan, bound: str) -> None:
    """Time ticks of a plan."""
    cv2.setNumThreads(1)
    ticks = Ticks(plan, *rendered(plan.camera))
    paired(
        benchmark,
        ticks.tick,
        ticks.bare,
        rounds=FRAMES - 1,
        against="calcOpticalFlowPyrLK there and back",
        bound=bound,
    )
    benchmark.extra_info["notes"] = {
        name: f"{1e3 * statistics.median(values):.1f} ms" for name, values in ticks.seconds.items()
    }
    ticks.klt.close()


@pytest.mark.parametrize("scheme", ["trifocal", "epipolar", "pose"])
def test_tick(benchmark: Any, scheme: str) -> None:
    """One tick at 800×600 with 100 features, by stage."""
    measured(benchmark, plan_of(scheme), "1.3")


@pytest.mark.parametrize("width", [400, 1600])
def test_tick_by_image_size(benchmark: Any, width: int) -> None:
    """The trifocal tick at other image sizes."""
    measured(benchmark, plan_of("trifocal", f"camera.width={width}"), "")
