"""The stages of many runs: `visctrl.runtime.loop` in arrays.

Robots in which something happens that a stage is not made for leave it without a result; the
ordinary session drives them instead.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np

from visctrl.hal.types import Pose
from visctrl.montecarlo.bases import Bases, Guards
from visctrl.montecarlo.eyes import Eyes, View
from visctrl.montecarlo.planar_fit import Rays
from visctrl.montecarlo.robots import Array, Mask, Robots, Velocities
from visctrl.perception.features import FeaturesOptions
from visctrl.runtime.plan import Plan
from visctrl.runtime.session import STANDING

#: Robots that have left a stage are carried along until they are this share of all.
_IDLE = 1.0 / 8.0


class Fleet(Robots):
    """R robots under way, which have taken their target and initial views.

    Parameters
    ----------
    plan : Plan
        Of any of the runs: they differ in start and seed only.
    numbers : sequence of int
        Which runs these are.
    starts, seeds : sequences of Pose and int
    scenes : (R, N, 3) array

    Attributes
    ----------
    target, sigma : View, (R,) array
        From the target, and the standard deviation of a bearing (rad).
    initial : View
        From where the robots last took it.
    ticks, fewest : (R,) arrays
        Ticks so far, and the least number of features in one of the main stage.
    moved : (R,) array
        Whether the robot has been told to move in the last stage.
    finished : (R,) array
        Whether the last stage ended by its controller's word; else by its time.
    """

    def __init__(
        self,
        plan: Plan,
        numbers: Sequence[int],
        starts: Sequence[Pose],
        seeds: Sequence[int],
        scenes: Array,
    ) -> None:
        count = len(numbers)
        self.number, self.seed = np.array(numbers), np.array(seeds)
        self.bases, self.eyes = Bases(np.array(starts), plan), Eyes(plan, scenes, seeds)
        self.target, self.sigma = self.eyes.target()
        self.initial = self.eyes.look(self.bases.pose)
        self.ticks = np.zeros(count, dtype=np.int64)
        self.fewest = np.full(count, self.eyes.features)
        self.moved, self.finished = np.zeros((2, count), dtype=np.bool_)

    def __len__(self) -> int:
        return len(self.number)

    def against_target(self, view: View) -> Rays:
        """Return a view paired with that from the target, with what the initial one shows, too."""
        shared = view.seen * self.initial.seen * self.target.seen
        return Rays(view.parts, self.target.parts, shared, self.sigma)

    def settle(self, plan: Plan) -> None:
        """Wait until all stand, or the time allowed: see `visctrl.runtime.session`."""
        bases = self.bases
        deadline = bases.now + plan.scenario.approach.settle_s
        standing = np.zeros(len(self), dtype=np.int64)
        while (waiting := (standing < 2) & (bases.now < deadline)).any():
            bases.sleep_until(np.where(waiting, bases.now + plan.period_s, bases.now))
            v, omega = bases.set_point
            still = (np.abs(v) < STANDING[0]) & (np.abs(omega) < STANDING[1])
            standing = np.where(waiting, np.where(still, standing + 1, 0), standing)


class Stage(Robots):
    """One stage of R runs.

    Parameters
    ----------
    fleet : Fleet
        Standing.
    plan : Plan
        Of any of the runs.

    Attributes
    ----------
    sent : Velocities
        What the bases were told last.
    gone : (R,) array
        Who has left the stage, one way or another.
    """

    def __init__(self, fleet: Fleet, plan: Plan) -> None:
        perception, count = plan.perception.options, len(fleet)
        assert isinstance(perception, FeaturesOptions)
        self.fleet, self.sent, self.enough = fleet, Velocities.none(count), perception.min_features
        self.gone, fleet.moved = np.zeros((2, count), dtype=np.bool_)
        self._origin, self._period = fleet.bases.now, plan.period_s
        self._guards = Guards(count, plan.limits)

    @abstractmethod
    def decide(self, view: View, dt: Array, *, first: bool) -> tuple[Velocities, Mask, Mask]:
        """Return the velocities wanted, who has finished, and for whom this stage is not made.

        Parameters
        ----------
        view : View
            What is seen now.
        dt : (R,) array
            Time since the last tick, the period for the first (s).
        first : bool
            It is the first tick.
        """

    def run(self, duration: float) -> Fleet:
        """Tick until all have finished or the time (s) is over; return these, told to stand."""
        stage, number = self, 0
        ended = [self.fleet.take(np.arange(0))]
        while len(stage.gone):
            bases, before = stage.fleet.bases, stage.fleet.bases.now
            bases.sleep_until(stage._origin + number * stage._period)
            late = ~stage.gone & (bases.now - stage._origin > duration)
            ended += stage._leave(late, finished=False)
            dt = bases.now - before if number else np.full(len(before), stage._period)
            ended += stage._tick(dt, first=not number)
            number += 1
            if np.count_nonzero(stage.gone) >= _IDLE * len(stage.gone):
                stage = stage.take(np.flatnonzero(~stage.gone))
        return Fleet.joined(ended)

    def _tick(self, dt: Array, *, first: bool) -> list[Fleet]:
        """Do one tick; return those that have finished."""
        fleet, bases = self.fleet, self.fleet.bases
        bases.look()
        fleet.ticks = fleet.ticks + 1
        view = fleet.initial if first else fleet.eyes.look(bases.pose)
        wanted, finished, irregular = self.decide(view, dt, first=first)
        irregular = irregular | ~np.isfinite(wanted.v + wanted.omega)
        standing = self.gone | finished | irregular
        self.sent = bases.command(self._guards.permit(wanted, dt).only(~standing))
        self._guards.was_sent(self.sent)
        fleet.moved = fleet.moved | (self.sent.v != 0.0) | (self.sent.omega != 0.0)
        self.gone = self.gone | irregular
        return self._leave(finished & ~self.gone, finished=True)

    def _leave(self, which: Mask, *, finished: bool) -> list[Fleet]:
        """Let some leave and tell them to stand; return them as a fleet, if there are any."""
        if not which.any():
            return []
        fleet = self.fleet.take(np.flatnonzero(which))
        self.gone = self.gone | which
        self.fleet.eyes.close(which)
        fleet.finished = np.full(len(fleet), finished)
        fleet.bases.stop()
        return [fleet]
