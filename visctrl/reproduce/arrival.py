"""The arrival check on rendered pictures: whether its doubt is right, and far called near."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.types import Frame, Pose
from visctrl.reproduce.entry import Bench, Row
from visctrl.robots.errors import InputError
from visctrl.studies.run_spec import RunSpec

if TYPE_CHECKING:
    from visctrl.runtime.plan import Plan
    from visctrl.schemes.arrival.check import ArrivalCheck, Verdict
    from visctrl.sim.render.renderer import Renderer
    from visctrl.sim.world.scene import Scene

Grey = NDArray[np.uint8]

#: Worlds in which arrival can be decided, and those that repeat themselves.
SCENES = (
    *("hall", "office", "sparse", "corridor", "tiles", "clutter", "far-hall", "yard"),
    *("warehouse", "workshop", "glass", "pillars", "random:1", "random:2", "random:3"),
)
_CENTRE = ("camera_error.cx_px=10", "camera_error.cy_px=-6")


@dataclass(frozen=True)
class Condition:
    """What differs between the target's picture and the one that is judged.

    settings : laid over the scenario. gain, gamma : of the picture. side : light from one side.
    moved : share of the scene's things that are elsewhere.
    """

    name: str
    settings: tuple[str, ...] = ()
    gain: float = 1.0
    gamma: float = 1.0
    side: float = 0.0
    moved: float = 0.0


CONDITIONS = (
    Condition("nothing changed"),
    Condition("800 px wide", ("camera.width=800",)),
    Condition("fisheye", ("camera.name=fisheye", "camera.width=400")),
    Condition("perspective", ("camera.name=perspective", "camera.width=400")),
    Condition("image centre off by 2.5 %", _CENTRE),
    Condition("xi off by 0.1", ("camera_error.xi=0.1",)),
    Condition("light x 0.6", gain=0.6),
    Condition("light x 1.4, gamma 1.5", gain=1.4, gamma=1.5),
    Condition("light from one side", side=0.4),
    Condition("a third of the things moved", moved=1.0 / 3.0),
)
#: A good end, as the schemes reach it (standard deviations), and how many are drawn; then places
#: that are too far off, each in a direction of its own.
_GOOD_M, _GOOD_RAD, _GOOD = 0.003, math.radians(0.15), 5
_OFF_M, _OFF_DEG = (0.01, 0.025, 0.05, 0.2), (0.5, 1.2)
#: What withholding ``reached`` is wrong within: well inside the tolerance.
_SURELY_M, _SURELY_DEG = 0.005, 0.5
_NOISE = 2.0
#: Where the robot comes from, in how many steps, and the scale of its wheels.
_BEGIN, _STEPS, _WHEELS = (0.3, -1.5, math.radians(10.0)), 24, 1.1


def arrival(bench: Bench) -> list[Row]:
    """Judge pictures from many places about the target of each world, under each condition."""
    rows, everything = [], []
    for condition in CONDITIONS:
        jobs = [
            RunSpec("default", (f"sim.scene={scene}", *_settings(condition), f"seed={number}"))
            for number, scene in enumerate(SCENES)
        ]
        cases = [
            {"condition": condition.name, **case}
            for summary in bench.run(jobs, partial(judged, condition))
            for case in summary["cases"]
        ]
        everything += cases
        rows.append(_row(condition.name, cases))
    rows.append(_row("all", everything))
    with (bench.out / "arrival.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(everything[0]))
        table.writeheader()
        table.writerows(everything)
    return rows


def _settings(condition: Condition) -> tuple[str, ...]:
    sized = any(text.startswith("camera.width") for text in condition.settings)
    width = () if sized else ("camera.width=400",)
    return ("backend=sim", *width, *condition.settings)


def judged(
    condition: Condition, job: RunSpec, places: Sequence[Pose] = (), *, drive: bool = True
) -> dict[str, Any]:
    """Return what the check says of pictures from about one target, beside the truth.

    places : where from; drawn as the entry does if there are none. drive : whether to come from
        afar.
    """
    from visctrl.schemes.arrival.check import ArrivalCheck, Tolerance
    from visctrl.sim.options import SimOptions
    from visctrl.sim.render.renderer_choice import open_renderer
    from visctrl.sim.world.scene import load_scene

    plan = job.plan()
    assert isinstance(plan.backend_options, SimOptions)
    options, height = plan.backend_options, plan.mount.height_m
    rng = np.random.default_rng([plan.scenario.seed, 9])
    scene = load_scene(options.scene)
    check = ArrivalCheck(plan.camera, height, Tolerance(0.02, math.radians(1.0)))
    renderer = open_renderer(options.renderer, scene, plan.true_camera)
    home = Pose(0.0, 0.0, 0.0)
    picture = renderer.render(home, height)
    taught = [_noisy(picture, rng) for _ in range(3)]
    frames = [Frame(0.0, k, image) for k, image in enumerate(taught)]
    check.set_target(frames)
    if drive:
        _drive(plan, check, frames, lambda pose: _noisy(renderer.render(pose, height), rng))
    if condition.side:
        renderer.close()
        light = scene.light.model_copy(update={"side": condition.side})
        scene = scene.model_copy(update={"light": light})
        renderer = open_renderer(options.renderer, scene, plan.true_camera)
    _move(renderer, scene, condition.moved, rng)
    cases = []
    for number, pose in enumerate(places or _places(rng)):
        picture = _lit(renderer.render(pose, height), condition)
        verdict = check.judge([Frame(1.0, number, _noisy(picture, rng))])
        cases.append({"scene": options.scene, **_case(pose, verdict)})
    renderer.close()
    return {"cases": cases}


def _drive(
    plan: Plan, check: ArrivalCheck, target: Sequence[Frame], look: Callable[[Pose], Grey]
) -> None:
    """Come from behind with the scenario's perception, on wheels whose scale is wrong.

    Where it does not recognise the target, the check goes without views on the way.
    """
    perception = plan.perception.build(plan.context(lockstep=True))
    perception.set_target(target)
    way = [Pose(*place) for place in np.linspace(_BEGIN, (0.0, 0.0, 0.0), _STEPS).tolist()]
    try:
        first = Frame(0.0, 0, look(way[0]))
        check.set_initial(first)
        perception.set_initial(first)
    except InputError:
        return
    for number, pose in enumerate(way, 1):
        views = perception.update(Frame(0.1 * number, number, look(pose)))
        check.pass_by(views, Pose(_WHEELS * pose.x, _WHEELS * pose.y, pose.phi))
    perception.close()


def _places(rng: np.random.Generator) -> Iterator[Pose]:
    for _ in range(_GOOD):
        x, y = (_GOOD_M * rng.standard_normal(2)).tolist()
        yield Pose(x, y, float(_GOOD_RAD * rng.standard_normal()))
    for off in _OFF_M:
        angle = rng.uniform(-math.pi, math.pi)
        yield Pose(off * math.cos(angle), off * math.sin(angle), 0.0)
    for turn in _OFF_DEG:
        yield Pose(0.0, 0.0, math.radians(turn) * float(rng.choice((-1.0, 1.0))))


def _move(renderer: Renderer, scene: Scene, share: float, rng: np.random.Generator) -> None:
    """Move a share of the things by 0.1 to 0.5 m, and turn them by some 10 deg."""
    count = round(share * len(scene.items))
    for index in rng.permutation(len(scene.items))[:count]:
        item = scene.items[index]
        step, angle = rng.uniform(0.1, 0.5), rng.uniform(-math.pi, math.pi)
        x, y = item.at_m[0] + step * math.cos(angle), item.at_m[1] + step * math.sin(angle)
        yaw = math.radians(item.yaw_deg + rng.normal(0.0, 10.0))
        renderer.place(item.name, Pose(x, y, yaw))


def _lit(picture: Grey, condition: Condition) -> Grey:
    levels = 255.0 * (np.arange(256) / 255.0) ** condition.gamma * condition.gain
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)[picture]


def _noisy(picture: Grey, rng: np.random.Generator) -> Grey:
    noisy = picture + _NOISE * rng.standard_normal(picture.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _case(pose: Pose, verdict: Verdict) -> dict[str, Any]:
    case: dict[str, Any] = {
        "answer": verdict.answer.value,
        "reason": verdict.reason,
        "x_m": pose.x,
        "y_m": pose.y,
        "phi_deg": math.degrees(pose.phi),
        "agree": verdict.agree,
        "coincide": verdict.coincide,
    }
    names = ("x", "y", "phi")
    case |= dict.fromkeys([f"{name}_{what}" for name in names for what in ("fit", "sd")], math.nan)
    if verdict.left is not None:
        sds = np.sqrt(np.diag(verdict.left.covariance)).tolist()
        for name, fit, sd in zip(names, verdict.left.pose, sds, strict=True):
            case |= {f"{name}_fit": fit, f"{name}_sd": sd}
    return case


def _row(name: str, cases: list[dict[str, Any]]) -> Row:
    """Return how often the truth was within two standard deviations, and what was said."""
    inside, good, withheld, false, undecided = [], 0, 0, 0, 0
    for case in cases:
        distance, heading = math.hypot(case["x_m"], case["y_m"]), abs(case["phi_deg"])
        there = case["answer"] == "there"
        false += there and (distance > 0.02 or heading > 1.0)
        undecided += case["answer"] == "undecided"
        if distance < _SURELY_M and heading < _SURELY_DEG:
            good += 1
            withheld += not there
        for key, true in (("x", case["x_m"]), ("y", case["y_m"])):
            inside.append(abs(case[f"{key}_fit"] - true) <= 2.0 * case[f"{key}_sd"])
        turned = abs(case["phi_fit"] - math.radians(case["phi_deg"]))
        inside.append(turned <= 2.0 * case["phi_sd"])
    share = 100.0 * float(np.mean(inside))
    ours = {
        "pictures": float(len(cases)),
        "inside_2sd_percent": share,
        "good_ends": float(good),
        "withheld": float(withheld),
        "false_success": float(false),
        "undecided": float(undecided),
    }
    bounds = {"inside_2sd_percent": 90.0, "withheld": 0.0, "false_success": 0.0}
    honest = 90.0 <= share <= 98.0 and not withheld and not false
    return Row(name, ours, bound=bounds, ok=honest)
