"""Many robots turning to the target: `planar-motion` and `face-target` in arrays."""

from __future__ import annotations

import math

import numpy as np

from visctrl.montecarlo.bases import Shapers
from visctrl.montecarlo.eyes import View
from visctrl.montecarlo.fleet import Fleet, Stage
from visctrl.montecarlo.planar import search
from visctrl.montecarlo.planar_fit import Motions, Rays, refine
from visctrl.montecarlo.robots import Array, Mask, Robots, Velocities
from visctrl.robots import Limits
from visctrl.runtime.plan import Plan, StagePlan
from visctrl.schemes.approach.estimator import PlanarMotionOptions
from visctrl.schemes.approach.law import STANDING, FaceTargetOptions


class Approach(Stage):
    """The stage: every robot's motion to the target is followed from frame to frame.

    Parameters
    ----------
    fleet, plan
        See `Stage`.
    stage : StagePlan
        With `PlanarMotionEstimator` and `FaceTarget`.
    """

    def __init__(self, fleet: Fleet, plan: Plan, stage: StagePlan) -> None:
        super().__init__(fleet, plan)
        options, facing = stage.estimator.options, stage.controller.options
        assert isinstance(options, PlanarMotionOptions)
        assert isinstance(facing, FaceTargetOptions)
        self._options, self._faces = options, FaceTargets(len(fleet), facing, plan.limits)
        self._motions = search(
            fleet.against_target(fleet.initial),
            fleet.seed.tolist(),
            options.threshold_sigmas,
            options.hypotheses,
        )

    def decide(self, view: View, dt: Array, *, first: bool) -> tuple[Velocities, Mask, Mask]:
        """See `Stage`."""
        views = self.fleet.against_target(view)
        regular = views.shared.sum(axis=1) >= self.enough
        if not first:
            self._motions = follow(self._motions, views, self.sent.omega * dt, self._options)
        wanted = self._faces.update(self._motions.direction, dt)
        return wanted, self._faces.finished, ~(regular & self._motions.sound)


def follow(motions: Motions, views: Rays, turn: Array, options: PlanarMotionOptions) -> Motions:
    """Return motions refined on the next views, after a turn (R,) (rad).

    See `PlanarMotionEstimator`; where it would search from scratch the motion is not sound.
    """
    phi, direction = motions.phi - turn, motions.direction + turn
    limit = 2.0 * options.threshold_sigmas * views.sigma
    near = np.abs(views.residuals(phi, direction)) < limit[:, None]
    close = views.only(near)
    enough = close.shared.sum(axis=1) >= options.min_inliers * views.shared.sum(axis=1)
    found = refine(close, phi, direction)
    return found._replace(sound=found.sound & enough)


class FaceTargets(Robots):
    """The controllers of R robots: see `visctrl.schemes.approach.law.FaceTarget`.

    Attributes
    ----------
    finished : (R,) array
        Who faces the target.
    """

    def __init__(self, count: int, options: FaceTargetOptions, limits: Limits | None) -> None:
        self._options = options
        self._shapers = Shapers(count, limits, whole_units=True)
        self._sent = Velocities.none(count)
        self._bearing = np.full(count, np.nan)
        self._steady = np.zeros(count, dtype=np.intp)
        self.finished = np.zeros(count, dtype=np.bool_)

    def update(self, bearing: Array, dt: Array) -> Velocities:
        """Return the velocities for the target's bearings (R,), and set ``finished``."""
        options = self._options
        first = np.isnan(self._bearing)
        expected = np.where(first, bearing, self._bearing + self._sent.omega * dt)
        bearing = bearing + math.tau * np.round((expected - bearing) / math.tau)
        self._bearing = bearing
        facing = first & (np.abs(bearing) <= math.radians(options.start_deg))
        aligned = np.abs(bearing) <= math.radians(options.end_deg)
        aligned &= np.abs(self._sent.omega) <= STANDING
        self._steady = np.where(aligned, self._steady + 1, 0)
        self.finished = facing | (self._steady >= options.steady_ticks)
        # A bearing is clockwise, a turning rate counter-clockwise.
        bound = math.radians(options.omega_deg_s)
        omega = np.clip(-options.gain_s * bearing, -bound, bound)
        sent = self._shapers.command(Velocities(np.zeros_like(omega), omega), dt)
        self._sent = sent.only(~self.finished)
        return self._sent
