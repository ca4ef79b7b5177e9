"""The simulated backend keeps the contract of `hal.interfaces`."""

import math

import numpy as np
import pytest

from hal.central_camera import load_camera
from hal.types import Pose
from robots import load_robot
from sim.backend import SimBackend
from sim.options import SimOptions

pytestmark = pytest.mark.sim
START = Pose(-0.55, -1.35, math.radians(-35.0))


def backend(start: Pose = START, **options: object) -> SimBackend:
    robot = load_robot("p3dx")
    camera = load_camera("paracatadioptric").resized(400, 300)
    return SimBackend(
        robot,
        camera,
        camera,
        robot.mount("centre"),
        start,
        robot.operating,
        SimOptions.model_validate(options),
        seed=3,
        realtime=False,
    )


def test_teaching_visits_the_target_and_returns() -> None:
    with backend() as world:
        frames = world.teach(2)
        assert [frame.image.shape for frame in frames if frame.image is not None] == [
            (300, 400)
        ] * 2
        assert not np.array_equal(frames[0].image, frames[1].image)
        truth = world.truth()
        assert truth is not None
        assert np.allclose(truth, START, atol=1e-4)
        assert world.clock.now() == 0.0
