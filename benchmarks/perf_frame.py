"""What the simulated camera's frames cost, and how fast the simulation runs with them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle
from typing import Any

import numpy as np
import pytest
from bench_render import CAMERAS, Draw, camera_frames, plain_frames
from paired import paired

from visctrl.hal.types import Pose
from visctrl.runtime.config import load_scenario, parse_setting
from visctrl.runtime.plan import make_plan
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.session import run_session
from visctrl.sim.options import RendererName, SimOptions
from visctrl.sim.render.renderer_choice import drawer_problem
from visctrl.sim.world.engine import disconnect

ROUNDS = 10
RUNS = 3
POSES = [Pose(-0.55 * s, -1.35 * s, -0.6 * s) for s in np.linspace(1.0, 0.0, ROUNDS).tolist()]
AGAINST = "plain PyBullet frame"


@pytest.fixture(scope="module")
def plain() -> Iterator[Draw]:
    """Draw plain frames with one client for all of them."""
    draw, client = plain_frames(SimOptions())
    yield draw
    disconnect(client)


def measured(benchmark: Any, camera: str, drawer: RendererName, plain: Draw, bound: str) -> None:
    """Time frames of 800×600, noise and all, against plain ones of as many pixels."""
    if problem := drawer_problem(drawer):
        pytest.skip(problem)
    draw, renderer = camera_frames(camera, drawer, SimOptions())
    for pose in POSES:
        # Textures are loaded when they are first shown; that is not a frame's cost.
        draw(pose), plain(pose)
    ours, reference = cycle(POSES), cycle(POSES)
    paired(
        benchmark,
        lambda: draw(next(ours)),
        lambda: plain(next(reference)),
        rounds=ROUNDS,
        against=AGAINST,
        bound=bound,
    )
    renderer.close()


@pytest.mark.parametrize("camera", CAMERAS)
def test_frame(benchmark: Any, camera: str, plain: Draw) -> None:
    """One frame by PyBullet's software renderer."""
    measured(benchmark, camera, "tiny", plain, "0.9")


@pytest.mark.parametrize("camera", CAMERAS)
def test_gl_frame(benchmark: Any, camera: str, plain: Draw) -> None:
    """One frame by ray casting; two threads share the time."""
    measured(benchmark, camera, "gl", plain, "0.3")


@pytest.mark.parametrize("drawer", ["tiny", "gl"])
def test_simulation(benchmark: Any, drawer: RendererName, plain: Draw) -> None:
    """The default run: opening, teaching and matching included in the time, not in the factor."""
    if problem := drawer_problem(drawer):
        pytest.skip(problem)
    changes = [parse_setting(f"sim.renderer={drawer}")]
    plan = make_plan(load_scenario("default", changes, REGISTRIES.backends.names()))
    factors: list[float] = []

    def run() -> None:
        factors.append(run_session(plan).summary["real_time_factor"])

    paired(
        benchmark,
        run,
        lambda: plain(POSES[0]),
        rounds=RUNS,
        against=AGAINST,
        bound="3 x real time",
    )
    # Wall time, of the ticks alone; others' work slows it down, so the best of the runs.
    benchmark.extra_info["notes"] = {"x real time": f"{max(factors):.1f}"}
