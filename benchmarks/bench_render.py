"""What one frame of each omnidirectional camera costs, against one plain perspective frame.

Both are 800x600, of the same scene from the same poses, drawn in turn in this process. The plain
one is a single ``getCameraImage`` of TinyRenderer without a camera model, floor, ceiling or noise;
the other is all that a simulated camera does, by each renderer that works here and does not need a
graphics card. The exit code is 1 if it costs more processor time.

    python benchmarks/bench_render.py [--frames N]
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.types import Pose
from visctrl.robots.unicycle import to_rep103
from visctrl.sim.options import RendererName, SimOptions
from visctrl.sim.render.drawn import DrawnScene, TextureFiles
from visctrl.sim.render.imaging import Sensor
from visctrl.sim.render.renderer import Renderer
from visctrl.sim.render.renderer_choice import drawer_problem, open_renderer
from visctrl.sim.world.engine import connect, disconnect, pybullet
from visctrl.sim.world.scene import load_scene

RENDERERS: tuple[RendererName, ...] = ("tiny", "gl")
CAMERAS = ("hypercatadioptric", "paracatadioptric", "fisheye")
WIDTH, HEIGHT = 800, 600
EYE_M = 0.75
#: An omnidirectional frame may cost this many plain ones.
BOUND = 1.0

Draw = Callable[[Pose], object]


def plain_frames(options: SimOptions) -> tuple[Draw, int]:
    """Return a function that draws a plain frame, and the client it draws in."""
    camera = load_camera("perspective").altered(
        width=WIDTH, height=HEIGHT, fx=750.0, fy=750.0, cx=399.5, cy=299.5
    )
    client = connect()
    scene = load_scene(options.scene)
    drawn = DrawnScene(client, scene, camera, TextureFiles.shared(), mipmapped=False)
    angle = math.degrees(2 * math.atan(HEIGHT / 2 / camera.fy))
    projection = pybullet.computeProjectionMatrixFOV(angle, WIDTH / HEIGHT, 0.05, 60.0)

    def draw(pose: Pose) -> object:
        drawn.prepare(pose, EYE_M)
        x, y, yaw = to_rep103(pose).tolist()
        ahead = [x + math.cos(yaw), y + math.sin(yaw), EYE_M]
        view = pybullet.computeViewMatrix([x, y, EYE_M], ahead, [0.0, 0.0, 1.0])
        return pybullet.getCameraImage(
            WIDTH,
            HEIGHT,
            view,
            projection,
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=client,
        )

    return draw, client


def camera_frames(name: str, drawer: RendererName, options: SimOptions) -> tuple[Draw, Renderer]:
    """Return a function that draws and exposes a camera's frame, and its renderer."""
    camera = load_camera(name)
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    scene = load_scene(options.scene)
    renderer = open_renderer(drawer, scene, camera, options.detail, options.show_floor)
    sensor = Sensor(WIDTH, HEIGHT, options.image_noise, options.blur_px, options.exposure, 0)
    return lambda pose: sensor.expose(renderer.render(pose, EYE_M), 0.0, 1), renderer


def timed(draw: Draw, pose: Pose) -> tuple[float, float]:
    """Return wall and processor time (ms) of one frame."""
    wall, processor = time.perf_counter(), time.process_time()
    draw(pose)
    return 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - processor)


def main() -> int:
    """Print a table and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=15)
    frames = parser.parse_args().frames
    options = SimOptions()
    share = np.linspace(0.0, 1.0, frames)
    poses = [Pose(-0.55 * (1 - s), -1.35 * (1 - s), -0.6 * (1 - s)) for s in share]
    plain, client = plain_frames(options)
    worst = 0.0
    print(
        f"{'camera':18} {'renderer':8} {'wall ms':>8} {'cpu ms':>7} {'plain wall':>11} "
        f"{'plain cpu':>10} ratio"
    )
    drawers = [drawer for drawer in RENDERERS if not drawer_problem(drawer)]
    for drawer, name in product(drawers, CAMERAS):
        draw, renderer = camera_frames(name, drawer, options)
        for pose in poses:
            # Textures are loaded when they are first shown; that is not a frame's cost.
            draw(pose), plain(pose)
        pairs = [(timed(draw, pose), timed(plain, pose)) for pose in poses]
        ratio = statistics.median(omni[1] / flat[1] for omni, flat in pairs)
        omni, flat = (np.median([pair[k] for pair in pairs], axis=0) for k in (0, 1))
        print(
            f"{name:18} {drawer:8} {omni[0]:8.1f} {omni[1]:7.1f} {flat[0]:11.1f} {flat[1]:10.1f} "
            f"{ratio:5.2f}"
        )
        worst = max(worst, ratio)
        renderer.close()
    disconnect(client)
    print(f"largest ratio {worst:.2f}, bound {BOUND:.2f}")
    return int(worst > BOUND)


if __name__ == "__main__":
    raise SystemExit(main())
