"""A simulated frame of each omnidirectional camera against a plain one of as many pixels."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle
from typing import Any

import numpy as np
import pytest
from bench_render import CAMERAS, Draw, camera_frames, plain_frames
from paired import paired

from hal.types import Pose
from sim.engine import disconnect
from sim.options import SimOptions

ROUNDS = 10
POSES = [Pose(-0.55 * s, -1.35 * s, -0.6 * s) for s in np.linspace(1.0, 0.0, ROUNDS).tolist()]


@pytest.fixture(scope="module")
def plain() -> Iterator[Draw]:
    """Draw plain frames with one client for all of them."""
    draw, client = plain_frames(SimOptions())
    yield draw
    disconnect(client)


@pytest.mark.parametrize("camera", CAMERAS)
def test_frame(benchmark: Any, camera: str, plain: Draw) -> None:
    """One frame of 800×600, noise and all."""
    draw, renderer = camera_frames(camera, SimOptions())
    for pose in POSES:
        # Textures are loaded when they are first shown; that is not a frame's cost.
        draw(pose), plain(pose)
    ours, reference = cycle(POSES), cycle(POSES)
    paired(
        benchmark,
        lambda: draw(next(ours)),
        lambda: plain(next(reference)),
        rounds=ROUNDS,
        against="plain PyBullet frame",
        bound="0.9",
    )
    renderer.close()
