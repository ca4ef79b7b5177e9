"""First matches of a start with the target in many worlds: how many are wrong and say nothing.

Pure perception: both images are rendered, matched as a run does at its start, and the motion that
was found is compared with the truth.
"""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from typing import Any, Literal, NamedTuple

import numpy as np

from visctrl.contracts import MatchedMotion, Perception
from visctrl.hal.types import Frame, Pose
from visctrl.perception.ambiguity import AmbiguousMatchError
from visctrl.reproduce.entry import Bench, Row, within
from visctrl.robots.errors import InputError
from visctrl.robots.unicycle import wrap_angle
from visctrl.sim.world.scene import Arena
from visctrl.studies.run_spec import RunSpec

#: A motion is wrong beyond these errors of heading and of the bearing of the start (deg), and
#: beyond this many of the standard deviations that it states itself, which count up to a bound.
HEADING_DEG, BEARING_DEG = 1.0, 1.5
SIGMAS, _MOST_SD_DEG = 3.0, 2.0
SEED = 9
PAIRS = 9
WIDTHS = (400, 800)
#: Starts: headings up to this (deg), and at least so far behind the target (m).
PHI_DEG, NEAREST_M = 40.0, 0.8
ACCEPTED, WRONG, NOT_RECOGNISED = "accepted", "wrong", "not recognised"
REFUSED, NEEDLESS = "refused", "needlessly refused"
#: Worlds in which places look alike, or next to nothing can be seen: a refusal is right there.
AMBIGUOUS = ("checkers", "pillars", "tiles", "warehouse", "wall", "sparse")
WELL_POSED = (
    "clutter",
    "corridor",
    "far-hall",
    "gallery",
    "glass",
    "hall",
    "office",
    "workshop",
    "yard",
)
#: Seeds of random rooms; none was looked at while the rules were made.
RANDOM_SEEDS = range(1000, 1021)
#: Worlds in which half of the things are moved between the two images.
MOVED = ("hall", "office", "clutter", "workshop", "random:1030", "random:1031")

Kind = Literal["well posed", "ambiguous", "half moved"]
HALF: Kind = "half moved"


class Case(NamedTuple):
    """Pairs of one kind, all in one world."""

    world: str
    kind: Kind


def cases() -> list[Case]:
    """Return all worlds."""
    return [
        *(Case(name, "well posed") for name in WELL_POSED),
        *(Case(f"random:{seed}", "well posed") for seed in RANDOM_SEEDS),
        *(Case(name, "ambiguous") for name in AMBIGUOUS),
        *(Case(name, "half moved") for name in MOVED),
    ]


def matches(bench: Bench) -> list[Row]:
    """Match starts in every world at both widths; count what was wrong or needlessly refused."""
    count = bench.repeats or PAIRS
    runs = [_spec(case, width, count) for case in cases() for width in WIDTHS]
    pairs = [pair for result in bench.run(runs, match_world) for pair in result["pairs"]]
    _write(bench, pairs)
    rows = []
    for kind in ("well posed", "ambiguous", "half moved"):
        for width in WIDTHS:
            chosen = [p for p in pairs if p["kind"] == kind and p["width"] == width]
            rows.append(_row(f"{kind}, {width} px wide", chosen))
    found = [p for p in pairs if p["kind"] == "well posed" and p["outcome"] != NOT_RECOGNISED]
    needless = sum(p["outcome"] == NEEDLESS for p in found)
    share = {"share_pct": 100.0 * needless / max(len(found), 1)}
    return [*rows, within("needless refusals, well posed", {"share_pct": 2.0}, share)]


def match_world(run: RunSpec) -> dict[str, Any]:
    """Match a run's world from several starts; return each pair's outcome."""
    from visctrl.sim.backend import SimBackend
    from visctrl.sim.options import Changes
    from visctrl.sim.world.changes import changed
    from visctrl.sim.world.eye import open_eye

    plan = run.plan()
    backend = plan.open_backend()
    assert isinstance(backend, SimBackend)
    scene = backend.scene()
    now = changed(scene, backend.setup.options.changes)
    perception = plan.perception.build(plan.context(lockstep=True))
    with ExitStack() as open_things:
        open_things.callback(perception.close)
        then = open_things.enter_context(closing(open_eye(backend.setup, scene, Changes())))
        here = then
        if now != scene:
            here = open_things.enter_context(closing(open_eye(backend.setup, now, Changes())))
        perception.set_target([then.photograph(0.0, Pose(0.0, 0.0, 0.0), moving=False)])
        pairs = [
            {
                "world": scene.name,
                "kind": plan.scenario.title,
                "width": plan.camera.width,
                "x_m": start.x,
                "y_m": start.y,
                "phi_deg": math.degrees(start.phi),
                **_outcome(perception, here.photograph(1.0 + k, start, moving=False), start),
            }
            for k, start in enumerate(_starts(scene.arena, int(run.values["pairs"])))
        ]
    return {"pairs": pairs}


def _outcome(perception: Perception[Any], frame: Frame, start: Pose) -> dict[str, Any]:
    try:
        motion = perception.set_initial(frame).motion
    except AmbiguousMatchError as error:
        result = _errors(error.motion, start)
        outcome = REFUSED if _wrong(result) else NEEDLESS
        return {"outcome": outcome, **result, "reason": str(error)}
    except InputError as error:
        return {"outcome": NOT_RECOGNISED, "reason": str(error)}
    assert motion is not None
    result = _errors(motion, start)
    return {"outcome": WRONG if _wrong(result) else ACCEPTED, **result}


def _errors(motion: MatchedMotion, start: Pose) -> dict[str, float]:
    """Return the errors of heading and bearing, and their standard deviations (deg)."""
    bearing = math.atan2(start.x, start.y)
    return {
        "heading_deg": abs(math.degrees(float(wrap_angle(motion.phi - start.phi)))),
        "bearing_deg": abs(math.degrees(float(wrap_angle(motion.direction - bearing)))),
        "heading_sd_deg": math.degrees(motion.phi_sd),
        "bearing_sd_deg": math.degrees(motion.direction_sd),
    }


def _wrong(result: Mapping[str, float]) -> bool:
    """Return whether a motion is wrong: off by more than allowed, and than it says itself."""
    return any(
        result[f"{what}_deg"] > max(most, SIGMAS * min(result[f"{what}_sd_deg"], _MOST_SD_DEG))
        for what, most in (("heading", HEADING_DEG), ("bearing", BEARING_DEG))
    )


def _starts(arena: Arena, count: int) -> list[Pose]:
    """Return starts in an arena, the same for every world that has one like it."""
    rng = np.random.default_rng([SEED, 5])
    low = np.array([arena.x_m[0], arena.y_m[0], -PHI_DEG])
    high = np.array([arena.x_m[1], -NEAREST_M, PHI_DEG])
    drawn = rng.uniform(low, high, (count, 3)).tolist()
    return [Pose(a, b, math.radians(c)) for a, b, c in drawn]


def _spec(case: Case, width: int, count: int) -> RunSpec:
    moved = ("sim.changes.moved=0.5", f"sim.changes.seed={SEED}") if case.kind == HALF else ()
    named = f"sim.scene='{case.world}'"
    return RunSpec(
        "default",
        (
            named,
            f"title={case.kind}",
            f"camera.width={width}",
            "sim.renderer=gl",
            f"seed={SEED}",
            *moved,
        ),
        values={"pairs": count},
    )


def _row(case: str, pairs: Sequence[Mapping[str, Any]]) -> Row:
    counted = Counter(pair["outcome"] for pair in pairs)
    ours = {
        "pairs": float(len(pairs)),
        "wrong": float(counted[WRONG]),
        "accepted": float(counted[ACCEPTED]),
        "refused, would be wrong": float(counted[REFUSED]),
        "refused, would be right": float(counted[NEEDLESS]),
        "not recognised": float(counted[NOT_RECOGNISED]),
    }
    return within(case, {"wrong": 0.0}, ours)


def _write(bench: Bench, pairs: Sequence[Mapping[str, Any]]) -> None:
    """Write every pair as CSV."""
    columns = list(dict.fromkeys(key for pair in pairs for key in pair))
    with (bench.out / "pairs.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(pairs)
