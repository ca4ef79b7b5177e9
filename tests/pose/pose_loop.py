"""The pose plugins in a closed loop with a `World`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pose_world import World

from visctrl.contracts import Decision, Health
from visctrl.hal.types import STANDSTILL
from visctrl.robots import Limits
from visctrl.robots.unicycle import wrap_angle
from visctrl.schemes.pose.estimate import Need
from visctrl.schemes.pose.estimator import PoseTransfer, TransferOptions
from visctrl.schemes.pose.estimator_ekf import EkfOptions, PoseEkf
from visctrl.schemes.pose.law import PoseTracking, PoseTrackingOptions

Array = NDArray[np.float64]
#: What is executed scatters by so much about what is commanded (m/s, rad/s).
NOISE = (0.002, math.radians(0.1))


@dataclass
class Run:
    """What came of a run.

    nees, nis, dof : one number a tick, from the first pose on.
    noise_factor : by how much the filter thinks it was told of too little noise, at the end.
    """

    world: World
    finished: bool = False
    time: float = 0.0
    reason: str = ""
    noise_factor: float = 1.0
    nees: list[float] = field(default_factory=list)
    nis: list[float] = field(default_factory=list)
    dof: list[float] = field(default_factory=list)
    path: list[Array] = field(default_factory=list)
    sent: list[tuple[float, float]] = field(default_factory=list)

    @property
    def error(self) -> Array:
        """Final error (cm, cm, deg)."""
        x, y, phi = self.world.pose
        return np.array([100 * x, 100 * y, math.degrees(wrap_angle(phi))])


def drive(
    world: World,
    *,
    period: float = 0.5,
    tau: float = 100.0,
    ekf: dict[str, Any] | None = None,
    transfer: dict[str, Any] | None = None,
    control: dict[str, Any] | None = None,
    blind: tuple[float, float] = (0.0, 0.0),
    limits: Limits | None = None,
    longest: float = 2.0,
) -> Run:
    """Drive to the target; without ``ekf`` the transfer filter estimates the pose.

    ``longest`` is how long it may take, in ``tau``.
    """
    context = replace(world.context(period), limits=limits)
    noise = {"v_m_s": world.noise[0], "omega_deg_s": math.degrees(world.noise[1])}
    estimator: PoseEkf | PoseTransfer
    if ekf is not None:
        estimator = PoseEkf(EkfOptions.model_validate({"noise": noise, **ekf}), context)
    else:
        options = TransferOptions.model_validate({"noise": noise, **(transfer or {})})
        estimator = PoseTransfer(options, context)
    controller = PoseTracking(
        PoseTrackingOptions.model_validate({"tau_s": tau, **(control or {})}), context
    )
    run, sent = Run(world), STANDSTILL
    for tick in range(int(longest * tau / period)):
        t = tick * period
        estimate = estimator.update(
            world.views(blind=blind[0] <= t < blind[1]), sent, period if tick else 0.0
        )
        decision = Decision()
        if estimate.health is not Health.LOST:
            decision = controller.update(estimate, sent, period if tick else 0.0)
        run.reason, run.time = estimate.reason, t
        if estimate.need is Need.NOTHING:
            error = world.pose - np.array(estimate.pose)
            error[2] = wrap_angle(error[2])
            run.nees.append(float(error @ np.linalg.solve(estimate.covariance, error)))
            values = estimator.values()
            run.nis.append(values.get("nis", 0.0))
            run.dof.append(values.get("nis_dof", 0.0))
            run.noise_factor = values.get("noise_factor", 1.0)
            run.path.append(world.pose.copy())
            run.sent.append((decision.velocity.v, decision.velocity.omega))
        if decision.finished:
            run.finished = True
            break
        sent = decision.velocity
        world.drive(sent, period)
    return run
