"""Closed loops of many ideal robots in one: the mock, the constrained tensor fit, the law.

It is for studies: thousands of starts and noises of one scenario. Robots for which something
out of the ordinary happens (a feature out of sight, a fit that is not sound, a retreat) are
driven again by the ordinary session, so the outcome is that of single runs in every case.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from hal.mock import MockBackend, MockOptions
from hal.types import Pose
from robots.unicycle import step_exact, wrap_angle
from visctrl.control.trifocal_smc import TrifocalSmc, TrifocalSmcOptions
from visctrl.estimation.initial_view import InitialView
from visctrl.estimation.tensor import Tensor
from visctrl.estimation.tensor_method import TensorOptions
from visctrl.geometry.planar import ransac_planar_motion
from visctrl.montecarlo.control import Laws
from visctrl.montecarlo.estimation import Tensors
from visctrl.montecarlo.fit import InitialViews
from visctrl.perception.features import IdentifiedFeatures
from visctrl.plugins import Health, Views
from visctrl.runtime.plan import Plan
from visctrl.runtime.session import run_session

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
T = TypeVar("T")

#: Robots in one array operation, and ticks of noise drawn at once.
BATCH, _AHEAD = 64, 64


@dataclass(frozen=True)
class Ending:
    """How a run ended.

    pose : the camera's true pose in the target's frame.
    finished : whether the controller said that it had.
    ticks : of the main stage.
    alone : the run was made by the ordinary session.
    """

    pose: Pose
    finished: bool
    ticks: int
    alone: bool = False


@dataclass
class _Start:
    """A robot at its start: its backend, and what it sees there."""

    backend: MockBackend
    pose: Pose
    views: Views
    initial: InitialView


def drive_many(plans: Sequence[Plan]) -> list[Ending]:
    """Run plans that differ in start and seed only; return how each ended, in their order.

    Plans that this is not made for (see `batchable`) are run one by one.
    """
    endings: dict[int, Ending] = {}
    for first in range(0, len(plans), BATCH):
        chosen = range(first, min(first + BATCH, len(plans)))
        starts = {k: start for k in chosen if (start := _start(plans[k])) is not None}
        if starts:
            endings.update(_drive(plans[next(iter(starts))], starts))
    return [endings[k] if k in endings else _alone(plan) for k, plan in enumerate(plans)]


def batchable(plan: Plan) -> bool:
    """Whether a plan is one of an ideal robot on the mock with the practical trifocal law."""
    tensor, law, mock = (
        plan.main.estimator.options,
        plan.main.controller.options,
        plan.backend_options,
    )
    return (
        plan.approach is None
        and plan.main.estimator.cls is Tensor
        and plan.main.controller.cls is TrifocalSmc
        and plan.perception.cls is IdentifiedFeatures
        and isinstance(tensor, TensorOptions)
        and (tensor.method, tensor.phi_1, tensor.scale) == ("constrained", "estimated", "odometry")
        and tensor.elevations
        and isinstance(law, TrifocalSmcOptions)
        and (law.law, law.finish) == ("practical", "threshold")
        and law.gains().threshold == 0.0
        and isinstance(mock, MockOptions)
        and mock.ideal
        and mock.faults == type(mock.faults)()
        and plan.mount.forward_m == 0.0
        and plan.target is None
        and not plan.scenario.realtime
    )


def _start(plan: Plan) -> _Start | None:
    """Return a robot that has taken its fixed views, None where it needs the ordinary session."""
    if not batchable(plan):
        return None
    backend = plan.open_backend()
    assert isinstance(backend, MockBackend)
    context = plan.context(lockstep=True)
    perception = plan.perception.build(context)
    options = plan.main.estimator.options
    assert isinstance(options, TensorOptions)
    with backend:
        perception.set_target(backend.teach(plan.scenario.target.frames))
        frame = backend.camera.read()
        perception.set_initial(frame)
        views = perception.update(frame)
    if len(views) < max(len(backend.scene), options.min_features):
        return None
    motion = ransac_planar_motion(
        views.initial,
        views.target,
        views.sigma,
        seed=context.seed,
        threshold_sigmas=options.threshold_sigmas,
        hypotheses=options.hypotheses,
    )
    if motion.health is not Health.OK or not np.isfinite(motion.covariance).all():
        return None
    return _Start(backend, plan.scenario.start.pose(), views, InitialView.of(motion))


def _drive(plan: Plan, starts: dict[int, _Start]) -> dict[int, Ending]:
    """Drive robots to their ends; those that leave the ordinary way are missing."""
    return _Batch(plan, starts).run()


class _Batch:
    """R robots under way. Every array attribute has the robots first."""

    def __init__(self, plan: Plan, starts: dict[int, _Start]) -> None:
        each = list(starts.values())
        tensor, law = plan.main.estimator.options, plan.main.controller.options
        assert isinstance(tensor, TensorOptions)
        assert isinstance(law, TrifocalSmcOptions)
        self._plan = plan
        self.number = np.array(list(starts))
        self.pose = np.array([start.pose for start in each])
        self.sent = np.zeros((len(each), 2))
        self.points = np.stack([start.backend.scene for start in each])
        self.current = np.stack([start.views.current for start in each])
        prior = np.array([(start.initial.phi, start.initial.bearing) for start in each])
        covariance = np.stack([start.initial.covariance for start in each])
        self.tensors = Tensors(
            np.stack([start.views.initial for start in each]),
            np.stack([start.views.target for start in each]),
            np.array([start.views.sigma for start in each]),
            InitialViews(prior, covariance),
            tensor,
        )
        self.laws = Laws(len(each), law)
        self._backends = {k: start.backend for k, start in starts.items()}
        assert isinstance(plan.backend_options, MockOptions)
        self._noisy = plan.backend_options.noise_px > 0.0
        self.noise = np.zeros((len(each), 0, *self.points.shape[1:2], 2))
        self._drawn = 0

    def run(self) -> dict[int, Ending]:
        """Tick until every robot has ended; return the endings by number."""
        period, duration = self._plan.period_s, self._plan.scenario.duration_s
        endings: dict[int, Ending] = {}
        tick, now, control_time = 0, 0.0, 0.0
        while len(self.number):
            start = tick * period
            dt = start - now if tick else period
            motion = np.zeros_like(self.pose)
            if tick:
                v, omega = self.sent.T
                self.pose = step_exact(self.pose, v, omega, dt)
                motion = step_exact(motion, v, omega, dt)
            if start > duration:
                endings.update(self._ended(np.ones(len(self.number), dtype=np.bool_), tick, False))
                break
            seen = self._look(tick) if tick else np.ones(len(self.number), dtype=np.bool_)
            situation = self.tensors.update(self.current, motion, dt)
            before = control_time
            control_time += dt if tick else 0.0
            self.sent = self.laws.update(situation, control_time - before if tick else period)
            tick, now = tick + 1, start
            lost = ~seen | self.laws.irregular
            endings.update(self._ended(self.laws.finished & ~lost, tick, True))
            on = ~(self.laws.finished | lost)
            if not on.all():
                self._keep(np.flatnonzero(on))
        return endings

    def _look(self, tick: int) -> Mask:
        """Take the current views; return (R,) who sees everything."""
        s, c = np.sin(self.pose[:, 2, None]), np.cos(self.pose[:, 2, None])
        rays = np.empty_like(self.points)
        dx = self.points[..., 0] - self.pose[:, 0, None]
        dy = self.points[..., 1] - self.pose[:, 1, None]
        rays[..., 0], rays[..., 1] = c * dx + s * dy, c * dy - s * dx
        rays[..., 2] = self.points[..., 2]
        pixels, seen = self._plan.true_camera.robot_pixels(rays)
        if self._noisy:
            pixels += self._next_noise(tick)
        self.current, valid = self._plan.camera.robot_rays(pixels)
        return np.asarray((seen & valid).all(axis=1))

    def _next_noise(self, tick: int) -> Array:
        """Return the noise (R, N, 2) of a tick, each robot's from its own generator."""
        at = (tick - 1) % _AHEAD
        if at == 0:
            drawn = [self._backends[k].noise(_AHEAD) for k in self.number.tolist()]
            self.noise = np.stack(drawn)
        return np.asarray(self.noise[:, at])

    def _ended(self, which: Mask, ticks: int, finished: bool) -> dict[int, Ending]:
        poses = self.pose[which].copy()
        poses[:, 2] = wrap_angle(poses[:, 2])
        numbers = self.number[which].tolist()
        return {
            k: Ending(Pose(*pose), finished, ticks)
            for k, pose in zip(numbers, poses.tolist(), strict=True)
        }

    def _keep(self, index: NDArray[np.intp]) -> None:
        """Go on with some of the robots."""
        self.tensors.views = _taken(self.tensors.views, index)
        self.tensors.relations = _taken(self.tensors.relations, index)
        self.tensors, self.laws = _taken(self.tensors, index), _taken(self.laws, index)
        for name in ("number", "pose", "sent", "points", "current", "noise"):
            setattr(self, name, getattr(self, name)[index])


def _alone(plan: Plan) -> Ending:
    """Run one plan by the ordinary session."""
    summary = run_session(plan).summary
    error = summary["final_error"]
    pose = Pose(error["x_m"], error["y_m"], np.radians(error["phi_deg"]).item())
    finished = "the controller finished" in summary["reason"]
    return Ending(pose, finished, summary["ticks"], alone=True)


def _taken(thing: T, index: NDArray[np.intp]) -> T:
    """Return a copy of a thing whose arrays have the robots first, with some of the robots."""
    taken = copy.copy(thing)
    for name, value in vars(thing).items():
        if isinstance(value, np.ndarray):
            setattr(taken, name, value[index])
    return taken
