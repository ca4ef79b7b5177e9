"""What the trifocal scheme's robust estimation costs and how good it is, beside a plain RANSAC.

Planar motion, 0.5 px noise, 30 % gross outliers, 60 features. Accuracy is the median bearing
error of the motion's direction; time is the median processor time of one call, on one thread.
The plain RANSAC is OpenCV's over five points (`findEssentialMat`). Then the tensor: 500
hypotheses of 60 features judged at once, and a whole tick of estimation and control.

    python benchmarks/bench_trifocal.py [--trials N] [--features N] [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from visctrl.contracts import Context, Views
from visctrl.geometry.trifocal.fit import refine
from visctrl.geometry.trifocal.motions import motions_of_tensor, share_in_front
from visctrl.geometry.trifocal.solvers import ransac_tensor
from visctrl.geometry.trifocal.tensor import CALIBRATED, trilinear
from visctrl.geometry.two_view.planar import ransac_planar_motion
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.mock.scene import seen_from
from visctrl.hal.types import Pose, Velocity
from visctrl.robots.unicycle import step_exact
from visctrl.schemes.trifocal.estimator import Tensor
from visctrl.schemes.trifocal.law_smc import TrifocalSmc, TrifocalSmcOptions
from visctrl.schemes.trifocal.tensor_method import TensorOptions

Array = NDArray[np.float64]
NOISE_PX = 0.5
OUTLIERS = 0.3
HYPOTHESES = 500
TARGET = Pose(0.0, 0.0, 0.0)
PLAIN, PLANAR, TENSOR = "five points, OpenCV RANSAC", "planar motion", "1D tensor, bearings only"


def scene(camera: CentralCamera, poses: list[Pose], count: int, rng: np.random.Generator) -> Array:
    """Return points 2 to 8 m ahead that every pose sees."""
    points = rng.uniform([-6.0, 2.0, -2.5], [6.0, 8.0, 2.5], (60 * count, 3))
    for pose in poses:
        points = points[camera.robot_pixels(seen_from(points, pose))[1]]
    return points[:count]


def picture(
    camera: CentralCamera, points: Array, pose: Pose, outliers: float, rng: np.random.Generator
) -> Array:
    """Return noisy pixels of the points, some of them exchanged for others."""
    pixels, _ = camera.robot_pixels(seen_from(points, pose))
    pixels = pixels + rng.normal(0.0, NOISE_PX, pixels.shape)
    wrong = rng.permutation(len(pixels))[: round(outliers * len(pixels))]
    pixels[wrong] = pixels[np.roll(wrong, 1)]
    return pixels


def methods(camera: CentralCamera, views: list[Array], seed: int) -> dict[str, Callable[[], float]]:
    """Return what is compared: each gives the target's bearing (rad) from the initial view.

    views : pixels in the initial, current and target image.
    """
    sigma = NOISE_PX / camera.fx
    initial, current, target = (camera.robot_rays(pixels)[0] for pixels in views)
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])

    def plain() -> float:
        E, _ = cv2.findEssentialMat(views[2], views[0], K, cv2.RANSAC, 0.999, 1.0)
        epipole = np.linalg.svd(E[:3])[0][:, 2]
        return math.atan2(epipole[0], epipole[2])

    def planar() -> float:
        return ransac_planar_motion(initial, target, sigma, seed=seed).direction

    def tensor() -> float:
        relation = trilinear(initial, current, target).within(CALIBRATED)
        z, agree = ransac_tensor(relation, sigma, seed=seed)
        motions = motions_of_tensor(CALIBRATED @ refine(relation.take(agree), z, sigma).z)
        front = share_in_front(motions, initial[agree], current[agree], target[agree])
        # Two motions remain; what was driven, straight ahead, tells the right one.
        turned = np.abs(np.sin(motions[:, 1, 0] - motions[:, 0, 0]))
        _, x, y = motions[np.argmin(turned - front), 0]
        return math.atan2(x, y)

    return {PLANAR: planar, TENSOR: tensor, PLAIN: plain}


def compare(camera: CentralCamera, trials: int, count: int) -> dict[str, dict[str, float]]:
    """Return median and 90th percentile of the error (deg) and time (ms) of each method."""
    errors: dict[str, list[float]] = {}
    times: dict[str, list[float]] = {}
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        pose = Pose(rng.uniform(-0.6, 0.6), rng.uniform(-3.5, -1.2), rng.uniform(-0.15, 0.15))
        on_the_way = Pose(*step_exact(np.array(pose), 1.0, 0.0, 0.5 * abs(pose.y)))
        points = scene(camera, [pose, on_the_way, TARGET], count, rng)
        views = [
            picture(camera, points, pose, 0.0, rng),
            picture(camera, points, on_the_way, 0.0, rng),
            picture(camera, points, TARGET, OUTLIERS, rng),
        ]
        true = math.atan2(-pose.x, -pose.y) + pose.phi
        for name, method in methods(camera, views, seed).items():
            began = time.process_time()
            found = method()
            times.setdefault(name, []).append(1e3 * (time.process_time() - began))
            error = abs(math.degrees(math.remainder(found - true, math.pi)))
            errors.setdefault(name, []).append(error)
    return {
        name: {
            "median_deg": float(np.median(errors[name])),
            "p90_deg": float(np.percentile(errors[name], 90)),
            "ms": float(np.median(times[name])),
        }
        for name in errors
    }


def hypotheses_ms(count: int, repeats: int = 60) -> float:
    """Return the median time (ms) of a RANSAC over `HYPOTHESES` five-feature samples."""
    camera, rng = load_camera("perspective"), np.random.default_rng(0)
    poses = [Pose(-0.3, -2.0, 0.1), Pose(-0.2, -1.0, 0.0), TARGET]
    points = scene(camera, poses, count, rng)
    rays = [camera.robot_rays(picture(camera, points, pose, 0.0, rng))[0] for pose in poses]
    relation, taken = trilinear(*rays).within(CALIBRATED), []
    for seed in range(repeats):
        began = time.process_time()
        ransac_tensor(relation, NOISE_PX / camera.fx, seed=seed, hypotheses=HYPOTHESES)
        taken.append(1e3 * (time.process_time() - began))
    return float(np.median(taken))


def whole_tick(count: int) -> float:
    """Return the median time (ms) of estimation and control with ``count`` features."""
    camera, rng = load_camera("perspective"), np.random.default_rng(0)
    start = Pose(-0.3, -2.0, math.radians(-8.5))
    points = scene(camera, [start, TARGET, Pose(-0.15, -1.0, -0.1)], count, rng)
    context = Context(camera, None, 0.0, 0.1, 0, True)
    estimator = Tensor(TensorOptions(), context)
    controller = TrifocalSmc(TrifocalSmcOptions(tau_s=10.0), context)
    target, initial = (
        camera.robot_rays(picture(camera, points, pose, 0.0, rng))[0] for pose in (TARGET, start)
    )
    pose, sent, taken = np.array(start), Velocity(0.0, 0.0), []
    for k in range(80):
        pixels = picture(camera, points, Pose(*pose), 0.0, rng)
        rays = camera.robot_rays(pixels)[0]
        sigma, ids = NOISE_PX / camera.fx, np.arange(len(points))
        views = Views(ids, target, initial, rays, pixels, sigma, 0.1 * k)
        began = time.process_time()
        sent = controller.update(estimator.update(views, sent, 0.1), sent, 0.1).velocity
        taken.append(1e3 * (time.process_time() - began))
        pose = step_exact(pose, sent.v, sent.omega, 0.1)
    return float(np.median(taken))


def main() -> int:
    """Print the comparison; return 1 if a bound does not hold."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--features", type=int, default=60)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    results = compare(load_camera("perspective"), arguments.trials, arguments.features)
    batch, tick = hypotheses_ms(arguments.features), whole_tick(arguments.features)
    if arguments.json:
        print(json.dumps({"methods": results, "hypotheses_ms": batch, "tick_ms": tick}, indent=2))
    else:
        for name, found in results.items():
            print(
                f"{name:26s} median {found['median_deg']:6.3f} deg, 90 % {found['p90_deg']:6.3f} "
                f"deg, {found['ms']:6.2f} ms"
            )
        print(f"{HYPOTHESES} hypotheses of {arguments.features} features: {batch:.2f} ms")
        print(f"one tick of estimation and control: {tick:.2f} ms")
    accurate = results[PLANAR]["median_deg"] <= results[PLAIN]["median_deg"] / 2.0
    return 0 if accurate and batch <= 10.0 else 1


if __name__ == "__main__":
    sys.exit(main())
