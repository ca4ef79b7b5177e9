"""Closed loops of many robots in one: the mock, the constrained tensor fit, the trifocal law.

It is for studies: thousands of starts and noises of one scenario. Robots for which something
out of the ordinary happens (features lost, a fit that is not sound) are driven again by the
ordinary session, so the outcome is that of single runs in every case.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from visctrl.hal.mock.backend import MockOptions, Purpose
from visctrl.hal.mock.scene import scatter_many
from visctrl.hal.types import Pose
from visctrl.montecarlo.approach import Approach
from visctrl.montecarlo.fleet import Fleet
from visctrl.montecarlo.kinds import alike, batchable, kind_of
from visctrl.montecarlo.trifocal import Trifocal
from visctrl.robots.unicycle import wrap_angle
from visctrl.runtime.config import Scenario
from visctrl.runtime.plan import Plan, StagePlan
from visctrl.runtime.session import run_session
from visctrl.runtime.summary import judge

#: Robots in one array operation at most, and their features in all: they fit in a cache.
BATCH, _FEATURES = 256, 16_384


@dataclass(frozen=True)
class Ending:
    """How a run ended.

    summary : what `visctrl.runtime.summary.summarise` says of it; of a run that was not made by
        the ordinary session, only what follows from the run itself.
    alone : the run was made by the ordinary session.
    """

    summary: dict[str, Any]
    alone: bool = False

    @property
    def pose(self) -> Pose:
        """The camera's true pose in the target's frame."""
        error = self.summary["final_error"]
        return Pose(error["x_m"], error["y_m"], math.radians(error["phi_deg"]))

    @property
    def ticks(self) -> int:
        """Of all stages."""
        return int(self.summary["ticks"])


def drive_many(plans: Sequence[Plan]) -> list[Ending]:
    """Run plans and return how each ended, in their order.

    Those that differ in start and seed only share array operations. What these are not made for
    (see `batchable`) is run one by one. No ending depends on which other plans there are.
    """
    endings = drive_together(plans)
    return [
        ending or Ending(run_session(plan).summary, alone=True)
        for plan, ending in zip(plans, endings, strict=True)
    ]


def drive_together(plans: Sequence[Plan]) -> list[Ending | None]:
    """Run what can be run in array operations; None is for the ordinary session to run."""
    endings: list[Ending | None] = [None] * len(plans)
    for kind in _kinds(plans):
        options = plans[kind[0]].backend_options
        assert isinstance(options, MockOptions)
        size = min(max(_FEATURES // options.features, 1), BATCH)
        for first in range(0, len(kind), size):
            for number, ending in _drive(plans, kind[first : first + size]):
                endings[number] = ending
    return endings


def _kinds(plans: Sequence[Plan]) -> list[list[int]]:
    """Return the numbers of the plans that can be run together; of others there are none."""
    kinds: dict[str, list[list[int]]] = {}
    for number, plan in enumerate(plans):
        similar = kinds.setdefault(kind_of(plan), [])
        known = next((members for members in similar if alike(plans[members[0]], plan)), None)
        if known is not None:
            known.append(number)
        elif batchable(plan):
            similar.append([number])
    return [members for similar in kinds.values() for members in similar]


def _drive(plans: Sequence[Plan], numbers: Sequence[int]) -> Iterator[tuple[int, Ending]]:
    """Yield how runs of one kind ended, with their numbers; some may be missing."""
    plan = plans[numbers[0]]
    # Robots that have left are carried along for a while; nobody looks at their numbers.
    with np.errstate(all="ignore"):
        fleet = _started(plan, {number: plans[number].scenario for number in numbers})
        if len(fleet) and plan.approach is not None:
            fleet = _faced(fleet, plan, plan.approach)
        if not len(fleet):
            return
        fleet = Trifocal(fleet, plan).run(plan.scenario.duration_s)
        fleet.settle(plan)
        fleet.bases.look()
    yield from _endings(fleet, plan)


def _started(plan: Plan, scenarios: Mapping[int, Scenario]) -> Fleet:
    """Return the robots at their starts; those that see too little there are left out."""
    options = plan.backend_options
    assert isinstance(options, MockOptions)
    starts = {number: scenario.start.pose() for number, scenario in scenarios.items()}
    seeds = {number: scenario.seed for number, scenario in scenarios.items()}
    scenes = scatter_many(
        options.features,
        (options.near_m, options.far_m),
        plan.true_camera,
        plan.mount,
        list(starts.values()),
        [Purpose.SCENE.generator(seed) for seed in seeds.values()],
    )
    able = {k: scene for k, scene in zip(scenarios, scenes, strict=True) if scene is not None}
    return Fleet(
        plan,
        list(able),
        [starts[number] for number in able],
        [seeds[number] for number in able],
        np.array(list(able.values())).reshape(-1, options.features, 3),
    )


def _faced(fleet: Fleet, plan: Plan, stage: StagePlan) -> Fleet:
    """Return the robots after the turn to the target; those that had to turn look anew."""
    fleet = Approach(fleet, plan, stage).run(plan.scenario.approach.timeout_s)
    fleet = fleet.take(np.flatnonzero(fleet.finished))
    turned = fleet.take(np.flatnonzero(fleet.moved))
    turned.settle(plan)
    turned.initial = turned.eyes.look(turned.bases.pose)
    return Fleet.joined([fleet.take(np.flatnonzero(~fleet.moved)), turned])


def _endings(fleet: Fleet, plan: Plan) -> Iterator[tuple[int, Ending]]:
    poses = fleet.bases.pose
    poses[:, 2] = wrap_angle(poses[:, 2])
    columns = fleet.number, fleet.finished, fleet.ticks, fleet.fewest, fleet.bases.way
    rows = zip(*(column.tolist() for column in (*columns, fleet.bases.now, poses)), strict=True)
    for number, finished, ticks, fewest, way, now, pose in rows:
        x, y, phi = pose
        end = judge(plan, finished, Pose(x, y, phi), 0)
        summary = {
            "status": end.status,
            "reason": end.reason,
            "final_error": {"x_m": x, "y_m": y, "phi_deg": math.degrees(phi)},
            "path_length_m": way,
            "duration_s": now,
            "ticks": ticks,
            "features": {"min": fewest},
            "consistency": None,
        }
        yield number, Ending(summary)
