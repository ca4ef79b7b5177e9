"""What the epipoles cost and how good they are, beside bare OpenCV and PoseLib on the same data.

Planar motion, 0.5 px noise, a fifth of gross outliers. Accuracy is the median bearing error of
the current view's epipole; time is the median processor time of one call, on one thread. At the
end, one whole tick of estimation (three pairs) and control, with a perspective camera, where the
calibration is left open, and with a hyper-catadioptric one.

    python benchmarks/bench_epipolar.py [--trials N] [--features N] [--json]
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
from visctrl.geometry.two_view.general_motion import magsac
from visctrl.geometry.two_view.planar_free import ransac_planar_epipoles
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.mock.scene import seen_from
from visctrl.hal.types import Pose, Velocity
from visctrl.robots.unicycle import step_exact, wrap_angle
from visctrl.schemes.epipolar.estimator import Epipoles, EpipolesOptions
from visctrl.schemes.epipolar.law_smooth import EpipolarSmooth, EpipolarSmoothOptions

Array = NDArray[np.float64]
CAMERA = load_camera("perspective")
TICK_CAMERAS = (CAMERA, load_camera("hypercatadioptric"))
#: What a tick of estimation and control may cost, median (ms).
TICK_MS = 5.0
#: Relative difference of two medians that this many trials cannot tell from none.
MARGIN = 0.05
#: Each solver and what it is measured by.
COUNTERPARTS = {
    "planar-free": "OpenCV F MAGSAC",
    "fundamental": "OpenCV F MAGSAC",
    "essential": "OpenCV E MAGSAC",
}
NOISE_PX = 0.5
OUTLIERS = 0.2
K = np.array([[CAMERA.fx, 0.0, CAMERA.cx], [0.0, CAMERA.fy, CAMERA.cy], [0.0, 0.0, 1.0]])


def scene(
    poses: list[Pose], count: int, rng: np.random.Generator, camera: CentralCamera = CAMERA
) -> Array:
    """Return points that every pose sees."""
    points = rng.uniform([-6.0, 2.0, -2.5], [6.0, 12.0, 2.5], (60 * count, 3))
    for pose in poses:
        points = points[camera.robot_pixels(seen_from(points, pose))[1]]
    return points[:count]


def picture(
    points: Array,
    pose: Pose,
    outliers: float,
    rng: np.random.Generator,
    camera: CentralCamera = CAMERA,
) -> Array:
    """Return noisy pixels of the points, some of them grossly wrong."""
    pixels, _ = camera.robot_pixels(seen_from(points, pose))
    pixels = pixels + rng.normal(0.0, NOISE_PX, pixels.shape)
    wrong = rng.random(len(pixels)) < outliers
    pixels[wrong] = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (int(wrong.sum()), 2))
    return pixels


def bearing_error(epipole: Array, pose: Pose) -> float:
    """Return the error (rad) of an epipole in camera axes as the line towards the target."""
    true = math.atan2(-pose.x, -pose.y) + pose.phi
    found = math.atan2(epipole[0], epipole[2])
    return abs(math.remainder(found - true, math.pi))


def methods(a: Array, b: Array, seed: int) -> dict[str, Callable[[], Array]]:
    """Return what is compared: each gives the epipole of view a in camera axes."""
    sigma = NOISE_PX / CAMERA.fx
    rays_a, rays_b = (CAMERA.robot_rays(pixels)[0] for pixels in (a, b))
    points = [rays[:, [0, 2]] / rays[:, 1:2] for rays in (rays_a, rays_b)]

    def planar() -> Array:
        theta = ransac_planar_epipoles(*points, sigma, seed=seed).direction
        return np.array([math.sin(theta), 0.0, math.cos(theta)])

    def fundamental() -> Array:
        return magsac(*points, sigma, calibrated=False, seed=seed).epipole_a.direction

    def essential() -> Array:
        return magsac(*points, sigma, calibrated=True, seed=seed).epipole_a.direction

    def magsac_fundamental() -> Array:
        F, _ = cv2.findFundamentalMat(b, a, cv2.USAC_MAGSAC, 1.0, 0.999, 10_000)
        return np.asarray(np.linalg.inv(K) @ np.linalg.svd(F)[0][:, 2])

    def magsac_essential() -> Array:
        E, _ = cv2.findEssentialMat(b, a, K, cv2.USAC_MAGSAC, 0.999, 1.0)
        return np.asarray(np.linalg.svd(E[:3])[0][:, 2])

    return {
        "planar-free": planar,
        "fundamental": fundamental,
        "essential": essential,
        "OpenCV F MAGSAC": magsac_fundamental,
        "OpenCV E MAGSAC": magsac_essential,
    }


def compare(trials: int, count: int) -> dict[str, dict[str, float]]:
    """Return median error (deg) and time (ms) of each method."""
    errors: dict[str, list[float]] = {}
    times: dict[str, list[float]] = {}
    target = Pose(0.0, 0.0, 0.0)
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        pose = Pose(rng.uniform(-1.0, 1.0), rng.uniform(-6.0, -2.0), rng.uniform(-0.15, 0.15))
        points = scene([pose, target], count, rng)
        a, b = picture(points, pose, 0.0, rng), picture(points, target, OUTLIERS, rng)
        for name, method in methods(a, b, seed).items():
            began = time.process_time()
            epipole = method()
            times.setdefault(name, []).append(1e3 * (time.process_time() - began))
            errors.setdefault(name, []).append(math.degrees(bearing_error(epipole, pose)))
    return {
        name: {"error_deg": float(np.median(errors[name])), "ms": float(np.median(times[name]))}
        for name in errors
    }


def whole_tick(camera: CentralCamera, count: int) -> float:
    """Return the median time (ms) of estimation and control with ``count`` features."""
    rng = np.random.default_rng(0)
    start, origin = Pose(-1.0, -5.0, 0.1), Pose(0.0, 0.0, 0.0)
    points = scene([start, origin, Pose(-0.6, -3.0, -0.2)], count, rng, camera)
    context = Context(camera, None, 0.0, 0.1, 0, True)
    estimator = Epipoles(EpipolesOptions(), context)
    controller = EpipolarSmooth(EpipolarSmoothOptions(duration_s=20.0), context)
    target, initial = (
        camera.robot_rays(picture(points, p, 0.0, rng, camera))[0] for p in (origin, start)
    )
    sigma = NOISE_PX * float(np.median(camera.bearing_per_pixel(target)))
    pose, sent, taken = np.array(start), Velocity(0.0, 0.0), []
    for k in range(80):
        pixels = picture(points, Pose(*pose), 0.0, rng, camera)
        rays = camera.robot_rays(pixels)[0]
        ids = np.arange(len(points))
        views = Views(ids, target, initial, rays, pixels, sigma, 0.1 * k)
        began = time.process_time()
        sent = controller.update(estimator.update(views, sent, 0.1), sent, 0.1).velocity
        taken.append(1e3 * (time.process_time() - began))
        pose = step_exact(pose, sent.v, sent.omega, 0.1)
        pose[2] = wrap_angle(pose[2])
    return float(np.median(taken))


def main() -> int:
    """Print the comparison; return 1 where OpenCV is more accurate, or a tick too slow."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--features", type=int, default=100)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    results = compare(arguments.trials, arguments.features)
    ticks = {camera.name: whole_tick(camera, arguments.features) for camera in TICK_CAMERAS}
    accurate = True
    for name, found in results.items():
        reference = results[COUNTERPARTS.get(name, name)]
        found["time_ratio"] = found["ms"] / reference["ms"]
        accurate &= found["error_deg"] <= (1.0 + MARGIN) * reference["error_deg"]
    if arguments.json:
        print(json.dumps({"methods": results, "tick_ms": ticks}, indent=2))
    else:
        for name, found in results.items():
            beside = COUNTERPARTS.get(name)
            ratio = f"{found['time_ratio']:6.2f} times {beside}" if beside else ""
            print(f"{name:16s} {found['error_deg']:6.3f} deg {found['ms']:7.2f} ms {ratio}")
        for name, tick in ticks.items():
            print(f"one tick of estimation and control, {name}: {tick:.2f} ms")
    return 0 if accurate and max(ticks.values()) <= TICK_MS else 1


if __name__ == "__main__":
    sys.exit(main())
