"""Closed loops on the mock backend: exact unicycle, projected features, no scheduler."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from visctrl.contracts import Context, Decision, Health
from visctrl.hal.actuation import ActuationOptions, Limiter
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.interfaces import BackendSetup
from visctrl.hal.mock.backend import MockBackend, MockOptions
from visctrl.hal.types import STANDSTILL, Pose, Velocity
from visctrl.perception.features import FeaturesOptions, IdentifiedFeatures
from visctrl.robots import load_robot
from visctrl.schemes.approach.estimator import PlanarMotionEstimator, PlanarMotionOptions
from visctrl.schemes.approach.law import FaceTarget, FaceTargetOptions
from visctrl.schemes.trifocal.estimator import Tensor
from visctrl.schemes.trifocal.law_smc import TrifocalSmc, TrifocalSmcOptions
from visctrl.schemes.trifocal.tensor_method import TensorOptions

PERIOD = 0.1
LARGE = load_camera("hypercatadioptric").resized(1024, 768)
#: A base that acts 0.1 s late, in whole mm/s and deg/s, ramped.
REAL = ActuationOptions(delay_s=0.1)


@dataclass
class Outcome:
    """How a run ended: errors in m and rad, and what was sent on the way."""

    error: Pose
    finished: bool
    phase: str
    duration: float
    sent: list[Velocity] = field(default_factory=list)
    phases: list[str] = field(default_factory=list)
    path: list[Pose] = field(default_factory=list)

    @property
    def position(self) -> float:
        return math.hypot(self.error.x, self.error.y)

    @property
    def heading_deg(self) -> float:
        return abs(math.degrees(self.error.phi))


class Loop:
    """A mock robot with the plugins' context, perception set to target and start."""

    def __init__(
        self,
        start: tuple[float, float, float],
        mock: MockOptions,
        camera: CentralCamera | None = None,
        true_camera: CentralCamera | None = None,
        mount: str = "centre",
        seed: int = 0,
    ) -> None:
        robot = load_robot("p3dx")
        self.camera = camera or load_camera("hypercatadioptric")
        limits = None if mock.ideal else robot.operating
        pose = Pose(start[0], start[1], math.radians(start[2]))
        true = true_camera or self.camera
        self.backend = MockBackend(
            BackendSetup(robot, robot.mount(mount), self.camera, true, pose, limits, mock, seed)
        )
        offset = robot.mount(mount).forward_m
        self.context = Context(self.camera, limits, offset, PERIOD, seed, True)
        noise = max(mock.noise_px, 0.2)
        self.perception = IdentifiedFeatures(FeaturesOptions(noise_px=noise), self.context)
        self.backend.open()
        self.perception.set_target(self.backend.teach(1))
        self.perception.set_initial(self.backend.camera.read())

    def face(self, options: FaceTargetOptions | None = None, duration: float = 30.0) -> Outcome:
        """Turn to the target, and take the initial view anew."""
        outcome = self._run(
            PlanarMotionEstimator(PlanarMotionOptions(), self.context),
            FaceTarget(options or FaceTargetOptions(), self.context),
            duration,
        )
        self.perception.set_initial(self.backend.camera.read())
        return outcome

    def drive(
        self,
        tensor: TensorOptions | None = None,
        law: TrifocalSmcOptions | None = None,
        duration: float = 60.0,
    ) -> Outcome:
        """Drive to the target."""
        return self._run(
            Tensor(tensor or TensorOptions(), self.context),
            TrifocalSmc(law or TrifocalSmcOptions(), self.context),
            duration,
        )

    def _run(self, estimator, controller, duration: float) -> Outcome:
        backend, outcome = self.backend, Outcome(Pose(0, 0, 0), False, "", 0.0)
        begin = backend.clock.now()
        sent, dt = STANDSTILL, 0.0
        limiter = Limiter(self.context.limits, whole_units=backend.base.whole_units)
        estimator.reset()
        for tick in range(int(duration / PERIOD)):
            views = self.perception.update(backend.camera.read())
            estimate = estimator.update(views, sent, dt)
            if estimate.health is Health.LOST:
                decision = Decision(phase=outcome.phase)
                limiter.stop()
            else:
                decision = controller.update(estimate, sent, dt)
            assert decision.velocity.finite
            assert all(np.isfinite(list(controller.values().values())))
            outcome.finished, outcome.phase = decision.finished, decision.phase
            outcome.duration = tick * PERIOD
            if decision.finished:
                break
            dt = PERIOD
            sent = backend.base.command(limiter.limit(decision.velocity, PERIOD))
            outcome.sent.append(sent)
            outcome.phases.append(decision.phase)
            outcome.path.append(backend.truth())
            backend.clock.sleep_until(begin + (tick + 1) * PERIOD)
        backend.base.command(STANDSTILL)
        backend.clock.sleep_until(backend.clock.now() + 0.5)
        outcome.error = backend.truth()
        return outcome
