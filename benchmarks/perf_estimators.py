"""Our two-view estimators beside OpenCV's and PoseLib's, on the same correspondences."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import cycle
from typing import Any

import cv2
import numpy as np
import poselib
import pytest
from bench_epipolar import CAMERA, NOISE_PX, OUTLIERS, Array, bearing_error, methods, picture, scene
from paired import paired

from visctrl.geometry.two_view.planar import ransac_planar_motion
from visctrl.hal.types import Pose

TRIALS, FEATURES = 40, 100
REFERENCE = "OpenCV E MAGSAC"
OURS = ("tensor's motion", "planar-free", "fundamental", "essential")
THEIRS = ("OpenCV F MAGSAC", "PoseLib E", "PoseLib F")
PINHOLE = {
    "model": "PINHOLE",
    "width": CAMERA.width,
    "height": CAMERA.height,
    "params": [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy],
}


def trial(seed: int) -> tuple[Pose, dict[str, Callable[[], Array]]]:
    """Return a pose that sees the target, and every method's epipole of its view."""
    rng = np.random.default_rng(seed)
    target = Pose(0.0, 0.0, 0.0)
    pose = Pose(rng.uniform(-1.0, 1.0), rng.uniform(-6.0, -2.0), rng.uniform(-0.15, 0.15))
    points = scene([pose, target], FEATURES, rng)
    a, b = picture(points, pose, 0.0, rng), picture(points, target, OUTLIERS, rng)
    rays_a, rays_b = (CAMERA.robot_rays(pixels)[0] for pixels in (a, b))
    K = np.array([[CAMERA.fx, 0.0, CAMERA.cx], [0.0, CAMERA.fy, CAMERA.cy], [0.0, 0.0, 1.0]])
    options = {"max_epipolar_error": 1.0, "seed": seed}

    def planar() -> Array:
        motion = ransac_planar_motion(rays_a, rays_b, NOISE_PX / CAMERA.fx, seed=seed)
        return np.array([math.sin(motion.direction), 0.0, math.cos(motion.direction)])

    def essential() -> Array:
        found, _ = poselib.estimate_relative_pose(b, a, PINHOLE, PINHOLE, options, {})
        return np.asarray(found.t)

    def fundamental() -> Array:
        F, _ = poselib.estimate_fundamental(b, a, options, {})
        return np.asarray(np.linalg.inv(K) @ np.linalg.svd(F)[0][:, 2])

    theirs = {"PoseLib E": essential, "PoseLib F": fundamental}
    return pose, {"tensor's motion": planar, **methods(a, b, seed), **theirs}


@pytest.mark.parametrize("method", [*OURS, *THEIRS])
def test_epipole(benchmark: Any, method: str) -> None:
    """100 features, 0.5 px, a fifth of gross outliers in one view."""
    cv2.setNumThreads(1)
    trials = [trial(seed) for seed in range(TRIALS)]
    ours, reference = cycle(trials), cycle(trials)
    errors = {name: [] for name in (method, REFERENCE)}

    def run(name: str, source: Any) -> None:
        pose, found = next(source)
        errors[name].append(math.degrees(bearing_error(found[name](), pose)))

    paired(
        benchmark,
        lambda: run(method, ours),
        lambda: run(REFERENCE, reference),
        rounds=TRIALS,
        against="findEssentialMat USAC_MAGSAC",
    )
    benchmark.extra_info["notes"] = {
        "error": f"{np.median(errors[method]):.3f} deg",
        "its error": f"{np.median(errors[REFERENCE]):.3f} deg",
    }
