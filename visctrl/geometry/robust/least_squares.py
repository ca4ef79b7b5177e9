"""Levenberg–Marquardt and Gauss–Newton: the loops of every robust fit.

A problem says what its residuals are, how they are weighted (`losses`, `soft_l1`), and how a step
is solved for; the loop says whether a step is taken, how long it may be, and when it is the last.
`gauss_newton` is for a loss whose scale follows the residuals: there is no cost that two points
could be compared by. `levenberg_marquardt` runs several small problems of one kind side by side,
because an array operation on a hundred features costs its call, not its arithmetic: each goes its
own way, but all are linearised together, until the last one is done.
"""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

PointT = TypeVar("PointT")
LinearT = TypeVar("LinearT")
NormalT = TypeVar("NormalT")
StepT = TypeVar("StepT")


class Solved(NamedTuple, Generic[StepT]):
    """A step δ.

    gain : −gᵀ δ, which is δᵀ H δ, too: the step's squared length in standard deviations of what
        it corrects.
    length : in what ``Options.longest`` bounds.
    """

    step: StepT
    gain: float
    length: float = 0.0


class Problem(ABC, Generic[PointT, LinearT, NormalT, StepT]):
    """P least-squares problems that are linearised together.

    A point is where one of them stands, a normal its normal equations there (or whatever a step
    follows from), and a linear what is known of all at their points.
    """

    @abstractmethod
    def linearise(self, points: list[PointT]) -> tuple[LinearT, Sequence[float], Sequence[NormalT]]:
        """Return what is known at P points, the costs there, and the normal equations.

        Costs are half the sums of squares, as far as the loss counts them.
        """

    @abstractmethod
    def steps(self, normals: list[NormalT], damping: list[float]) -> Sequence[Solved[StepT]]:
        """Return the steps of some of the problems.

        Damping is added to the Hessian's diagonal, relative to it.
        """

    @abstractmethod
    def moved(self, point: PointT, step: StepT, part: float) -> PointT:
        """Return the point after a part of a step."""


@dataclass(frozen=True)
class Damping:
    """How Marquardt's damping changes.

    start : damping of the first step.
    shrink : its factor after a step that was good.
    grow, floor : its factor after one that was not, and what it is at least taken for then.
    """

    start: float = 0.0
    shrink: float = 0.1
    grow: float = 10.0
    floor: float = 1e-5


@dataclass(frozen=True)
class Options:
    """When steps are taken.

    iterations : at most so many steps.
    converged : a step whose gain is less is the last one; 0 takes all of them.
    longest : steps are shortened to this length.
    damping : of Levenberg–Marquardt; Gauss–Newton has none.
    """

    iterations: int
    converged: float = 0.0
    longest: float = math.inf
    damping: Damping = Damping()


class Minimum(NamedTuple, Generic[PointT, LinearT]):
    """Where the problems have ended.

    points : one a problem, after their last steps.
    evaluated, costs : the best points that were linearised, and the costs there.
    linear : of the last linearisation; last steps are too short to matter, and not in it.
    iterations : steps that the slowest problem took.
    """

    points: list[PointT]
    evaluated: list[PointT]
    costs: list[float]
    linear: LinearT
    iterations: int


def levenberg_marquardt(
    problem: Problem[PointT, LinearT, NormalT, StepT], starts: Sequence[PointT], options: Options
) -> Minimum[PointT, LinearT]:
    """Let problems descend from their starts by damped Gauss–Newton steps, none of them uphill."""
    rule, longest, converged = options.damping, options.longest, options.converged
    at, ahead, best = list(starts), list(starts), list(starts)
    costs = [math.inf] * len(at)
    normals: list[NormalT] = []
    damping, refused = [rule.start] * len(at), [False] * len(at)
    active = list(range(len(at)))
    for number in itertools.count(1):
        linear, new_costs, new_normals = problem.linearise(at)
        if number == 1:
            costs, normals = list(new_costs), list(new_normals)
        elif active:
            for k in active:
                refused[k] = not new_costs[k] <= costs[k]
                if refused[k]:
                    damping[k] = rule.grow * max(damping[k], rule.floor)
                else:
                    best[k], costs[k], normals[k] = at[k], new_costs[k], new_normals[k]
                    damping[k] *= rule.shrink
        else:
            break
        some = len(active) < len(at)
        steps = problem.steps(
            [normals[k] for k in active] if some else normals,
            [damping[k] for k in active] if some else damping,
        )
        moving = []
        for k, (step, gain, length) in zip(active, steps, strict=True):
            part = 1.0 if length <= longest else longest / length
            # Half of the gain is what the step should save. It cannot save more than there is:
            # where it seems to, the residuals are no noise, and the curvature is not the way's.
            if gain * part > 2.0 * costs[k]:
                part = 2.0 * costs[k] / gain
            ahead[k] = problem.moved(best[k], step, part)
            if gain >= converged and number < options.iterations:
                moving.append(k)
                at[k] = ahead[k]
            else:
                # Who keeps others waiting is left as it would be alone.
                at[k] = ahead[k] if refused[k] else best[k]
        active = moving
        if not active and not any(refused):
            break
    return Minimum(ahead, best, costs, linear, min(number, options.iterations))


class Descended(NamedTuple, Generic[PointT, LinearT, StepT]):
    """Where one problem has ended, what was known before its last step, and that step."""

    point: PointT
    linear: LinearT
    step: StepT
    iterations: int


def gauss_newton(
    at: Callable[[PointT], LinearT],
    solve: Callable[[LinearT], Solved[StepT]],
    moved: Callable[[PointT, StepT], PointT],
    start: PointT,
    options: Options,
) -> Descended[PointT, LinearT, StepT]:
    """Let one problem descend by Gauss–Newton steps, re-weighted at every one.

    Parameters
    ----------
    at : function
        From a point to its residuals, weights, and whatever else a step follows from.
    solve : function
        From that to the step.
    moved : function
        From a point and a step to the next point.
    start : where to begin.
    options : Options
    """
    point = start
    number = 0
    while number < options.iterations:
        number += 1
        linear = at(point)
        step, gain, length = solve(linear)
        if length > options.longest:
            # Arrays and complex numbers can be shortened; others give no length.
            step = step * (options.longest / length)  # type: ignore[operator, assignment]
        point = moved(point, step)
        if gain < options.converged:
            break
    return Descended(point, linear, step, number)
