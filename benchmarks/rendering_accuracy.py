"""How far known corners lie from the camera model in rendered frames, for every camera.

The distances are between where the model predicts a checkerboard corner and where a corner
detector finds it; the detector's own error, about 0.1 px (95 %), is included. The exit code is 1
if more than 5 % of a camera's corners are farther off than 0.2 px.

    python benchmarks/rendering_accuracy.py [--poses N] [--seed N]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from visctrl.hal.cameras.catalogue import camera_names, load_camera
from visctrl.hal.types import Pose
from visctrl.sim.options import RendererName
from visctrl.sim.render.accuracy import CornerErrors, checker_room, measure_corners
from visctrl.sim.render.renderer_choice import DRAWERS, drawer_problem, open_renderer

BOUND_PX = 0.2


def measured(name: str, drawer: RendererName, poses: list[Pose]) -> CornerErrors:
    """Return the errors of one camera, drawn by one renderer."""
    camera = load_camera(name)
    renderer = open_renderer(drawer, checker_room(), camera)
    try:
        return measure_corners(renderer, camera, poses)
    finally:
        renderer.close()


def main() -> int:
    """Print a table and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--poses", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    places = rng.uniform((-0.8, -0.8, -np.pi), (0.8, 0.8, np.pi), (arguments.poses, 3))
    poses = [Pose(*place) for place in places.tolist()]
    drawers = [drawer for drawer in DRAWERS if not drawer_problem(drawer)]
    worst = 0.0
    print(f"{'camera':18} {'renderer':8} corners  mean px   95 %   99 %  coverage")
    for drawer in drawers:
        for name in camera_names():
            found = measured(name, drawer, poses)
            bound, far = found.percentile(0.95), found.percentile(0.99)
            print(
                f"{name:18} {drawer:8} {len(found.errors):7}  {found.distances.mean():7.3f} "
                f"{bound:6.3f} {far:6.3f}  {found.coverage:8.2f}"
            )
            worst = max(worst, bound)
    print(f"largest 95 % distance {worst:.3f} px, bound {BOUND_PX} px")
    return int(worst > BOUND_PX)


if __name__ == "__main__":
    raise SystemExit(main())
