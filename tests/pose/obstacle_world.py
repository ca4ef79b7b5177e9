"""Runs on a mock among solid things, and an observer who knows when the robot touches one.

The plan geometry of `visctrl.sim.world.scene_world` stands for PyBullet's, in milliseconds a run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.interfaces import BackendSetup
from visctrl.hal.mock.backend import MockBackend, MockOptions
from visctrl.hal.types import Pose, Range
from visctrl.robots import Robot, load_robot
from visctrl.robots.unicycle import step_exact
from visctrl.runtime.config import Override, load_scenario
from visctrl.runtime.plan import make_plan
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.registry import Registries
from visctrl.runtime.session import Outcome, run_session
from visctrl.sim.options import Box
from visctrl.sim.world.scene import Item, Scene, load_scene
from visctrl.sim.world.scene_world import SceneWorld

Array = NDArray[np.float64]
ROBOT = load_robot("p3dx")
AHEAD = ROBOT.mount("front").forward_m


class SolidOptions(MockOptions):
    """A scene of the simulator, and boxes in it, for the sonar to hear."""

    scene: str = "hall"
    boxes: tuple[Box, ...] = ()


class SolidMock(MockBackend):
    """A mock with sonar rings."""

    Options: ClassVar[type[SolidOptions]] = SolidOptions

    def __init__(self, setup: BackendSetup[SolidOptions]) -> None:
        super().__init__(setup)
        options = setup.options
        self._solid = SceneWorld(scene_with(options.scene, options.boxes), setup.robot)

    @classmethod
    def measures_ranges(cls, robot: Robot, options: SolidOptions) -> bool:
        del options
        return robot.sonar is not None

    def open(self) -> None:
        super().open()
        self.base.ranges = self._ranges  # type: ignore[method-assign]

    def _ranges(self) -> list[Range]:
        truth, ring = self.truth(), self.robot.sonar
        assert truth is not None
        assert ring is not None
        found = []
        for at in ring.transducers.values():
            away = self._solid.sonar(axle(truth), at)
            away = away if away < ring.range_m else math.inf
            found.append(Range(-at.left_m, at.forward_m, -at.direction_rad, away))
        return found


def scene_with(name: str, boxes: Sequence[Box]) -> Scene:
    """Return a scene with more boxes in it."""
    scene = load_scene(name)
    items = [
        Item(
            name=f"box {number}",
            at_m=(box.x_m, box.y_m),
            size_m=(box.width_m, box.depth_m, box.height_m),
            yaw_deg=box.yaw_deg,
        )
        for number, box in enumerate(boxes)
    ]
    return scene.model_copy(update={"items": (*scene.items, *items)})


def axle(camera: Pose) -> Pose:
    """Return the pose of the axle's middle for one of the camera."""
    return Pose(*step_exact(camera, -AHEAD, 0.0, 1.0).tolist())


class Watch(Observer):
    """Follows the true pose, ten times as densely as the ticks.

    nearest : least distance of the outline from any of some discs (m).
    touched : whether the outline overlapped something of a scene.
    phases : what the controller was at, without repetitions.
    clipped : greatest difference between what was wanted and what was sent (m/s, rad/s).
    """

    def __init__(self, discs: Sequence[Sequence[float]] = (), solid: SceneWorld | None = None):
        self._discs = np.array(discs, dtype=float).reshape(-1, 3)
        self._solid = solid
        self._last: Pose | None = None
        self.nearest = math.inf
        self.touched = False
        self.phases: list[str] = []
        self.path: list[Pose] = []

    def on_tick(self, record: TickRecord) -> None:
        truth = record.truth
        assert truth is not None
        before = np.array(self._last or truth)
        step = np.array(truth) - before
        step[2] = math.remainder(step[2], math.tau)
        for share in np.linspace(0.1, 1.0, 10):
            self._look(axle(Pose(*(before + share * step).tolist())))
        self._last = truth
        self.path.append(truth)
        if not self.phases or self.phases[-1] != record.decision.phase:
            self.phases.append(record.decision.phase)

    def _look(self, here: Pose) -> None:
        if self._solid is not None:
            self.touched = self.touched or self._solid.blocked(here)
        if len(self._discs):
            self.nearest = min(self.nearest, float(gaps(here, self._discs).min()))


def gaps(axle: Pose, discs: Array) -> Array:
    """Return the exact distances (M,) of the robot's rectangle from discs (M, 3)."""
    s, c = math.sin(axle.phi), math.cos(axle.phi)
    dx, dy = discs[:, 0] - axle.x, discs[:, 1] - axle.y
    right, forward = c * dx + s * dy, c * dy - s * dx
    body = ROBOT.body
    aside = np.abs(right) - body.width_m / 2
    beyond = np.maximum(forward - body.front_m, -body.rear_m - forward)
    outside = np.hypot(np.maximum(aside, 0.0), np.maximum(beyond, 0.0))
    return np.asarray(outside + np.minimum(np.maximum(aside, beyond), 0.0) - discs[:, 2])


def run(settings: dict[str, Any], watch: Watch, backend: str = "mock") -> Outcome:
    """Run the pose scheme with some settings."""
    registries = Registries()
    registries.backends.builtin["solid"] = "obstacle_world:SolidMock"
    base = {"backend": backend, "scheme": "pose", **settings}
    overrides = [Override(tuple(k.split(".")), v, f"--set {k}") for k, v in base.items()]
    loaded = load_scenario("default", overrides, registries.backends.names())
    return run_session(make_plan(loaded, registries), observers=[watch])
