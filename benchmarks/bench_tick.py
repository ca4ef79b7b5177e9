"""What one tick costs: perception, estimation and control on rendered frames.

The frames of a short drive are rendered beforehand. The tracker's time is also given as a ratio
to the bare calls that it cannot do without: Lucas–Kanade there and back on the same images.

    python benchmarks/bench_tick.py [--camera NAME] [--frames N] [--threads N] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from visctrl.contracts import Context
from visctrl.hal.cameras.catalogue import camera_names, load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.interfaces import BackendSetup
from visctrl.hal.types import Frame, Pose, Velocity
from visctrl.perception.klt import Klt, KltOptions
from visctrl.robots import load_robot
from visctrl.schemes.trifocal.estimator import Tensor
from visctrl.schemes.trifocal.law_smc import TrifocalSmc, TrifocalSmcOptions
from visctrl.schemes.trifocal.tensor_method import TensorOptions
from visctrl.sim.backend import SimBackend
from visctrl.sim.options import SimOptions

T = TypeVar("T")
START = Pose(-0.5, -2.4, np.radians(-12.0))
VELOCITY, PERIOD_S = Velocity(0.3, 0.025), 0.1
# The bare tracking: window side (px) and pyramid levels above the image.
WINDOW, LEVELS = 15, 3


class Stopwatch:
    """Collects processor time and wall time (ms) of named stages."""

    def __init__(self) -> None:
        self.times: dict[str, list[tuple[float, float]]] = {}

    def time(self, stage: str, work: Callable[[], T]) -> T:
        """Do some work and note what it took."""
        cpu, wall = time.process_time(), time.perf_counter()
        result = work()
        took = 1e3 * (time.process_time() - cpu), 1e3 * (time.perf_counter() - wall)
        self.times.setdefault(stage, []).append(took)
        return result

    def summary(self) -> dict[str, dict[str, float]]:
        """Return the median and 99th percentile of every stage and of the tick."""
        stages = {name: np.array(times) for name, times in self.times.items()}
        parts = [stages[name] for name in ("perception", "estimation", "control")]
        stages["tick"] = np.sum(parts, axis=0)
        return {
            name: {
                "cpu_median_ms": float(np.median(times[:, 0])),
                "cpu_p99_ms": float(np.percentile(times[:, 0], 99)),
                "wall_median_ms": float(np.median(times[:, 1])),
                "wall_p99_ms": float(np.percentile(times[:, 1], 99)),
            }
            for name, times in stages.items()
        }


def drive(camera: CentralCamera, count: int) -> tuple[list[Frame], list[Frame]]:
    """Return the target frames and the frames of a drive towards the target."""
    robot = load_robot("p3dx")
    mount, limits = robot.mount("centre"), robot.operating
    backend = SimBackend(
        BackendSetup(robot, mount, camera, camera, START, limits, SimOptions(), seed=1)
    )
    with backend:
        target, frames = backend.teach(3), []
        for tick in range(count):
            backend.clock.sleep_until(tick * PERIOD_S)
            frames.append(backend.camera.read())
            backend.base.command(VELOCITY)
    return target, frames


def bare_tracking(previous: Frame, current: Frame, pixels: NDArray[np.float64]) -> None:
    """Track there and back, as OpenCV offers it."""
    assert previous.image is not None
    assert current.image is not None
    window, points = (WINDOW, WINDOW), pixels.astype(np.float32, order="C").reshape(-1, 1, 2)
    back = np.zeros(points.shape, np.float32)
    moved, _, _ = cv2.calcOpticalFlowPyrLK(
        previous.image,
        current.image,
        points,
        np.zeros(points.shape, np.float32),
        None,
        None,
        window,
        LEVELS,
    )
    cv2.calcOpticalFlowPyrLK(
        current.image, previous.image, np.asarray(moved), back, None, None, window, LEVELS
    )


def measure(camera: CentralCamera, count: int, features: int) -> dict[str, Any]:
    """Run the plugins over the frames and return the times."""
    target, frames = drive(camera, count)
    context = Context(camera, load_robot("p3dx").operating, 0.0, PERIOD_S, 0, True)
    klt = Klt(KltOptions(max_features=features), context)
    tensor, law = Tensor(TensorOptions(), context), TrifocalSmc(TrifocalSmcOptions(), context)
    klt.set_target(target)
    klt.set_initial(frames[0])
    tensor.reset()
    watch, seen, previous = Stopwatch(), [], frames[0]
    for number, frame in enumerate(frames[1:], start=1):
        views = watch.time("perception", partial(klt.update, frame))
        estimate = watch.time("estimation", partial(tensor.update, views, VELOCITY, PERIOD_S))
        watch.time("control", partial(law.update, estimate, number * PERIOD_S))
        watch.time("bare tracking", partial(bare_tracking, previous, frame, views.pixels))
        seen.append(len(views))
        previous = frame
    klt.close()
    stages = watch.summary()
    bare = stages["bare tracking"]["cpu_median_ms"]
    return {
        "camera": camera.name,
        "size": f"{camera.width}x{camera.height}",
        "frames": len(frames) - 1,
        "features_median": float(np.median(seen)),
        "opencv_threads": cv2.getNumThreads(),
        "stages": stages,
        "perception_over_bare_tracking": stages["perception"]["cpu_median_ms"] / bare,
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--camera", choices=camera_names(), default="hypercatadioptric")
    parser.add_argument("--frames", type=int, default=80)
    parser.add_argument("--features", type=int, default=100)
    parser.add_argument("--threads", type=int, default=1, help="OpenCV's threads")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    cv2.setNumThreads(arguments.threads)
    result = measure(load_camera(arguments.camera), arguments.frames, arguments.features)
    if arguments.json:
        print(json.dumps(result, indent=2))
        return
    print(
        f"{result['camera']} {result['size']}, {result['features_median']:.0f} features, "
        f"{result['frames']} ticks, OpenCV threads: {result['opencv_threads']}"
    )
    print(f"{'':16}{'cpu median':>12}{'cpu p99':>10}{'wall median':>13}{'wall p99':>10}  (ms)")
    for name, times in result["stages"].items():
        cells = [times[k] for k in times]
        print(f"{name:16}{cells[0]:12.1f}{cells[1]:10.1f}{cells[2]:13.1f}{cells[3]:10.1f}")
    ratio = result["perception_over_bare_tracking"]
    print(f"perception over bare tracking, processor time: {ratio:.2f}")


if __name__ == "__main__":
    main()
