"""Ways round obstacles: what they keep clear of, and whole runs that never touch."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from obstacle_world import AHEAD, ROBOT, Watch, axle, gaps, run
from scipy import ndimage

from visctrl.hal.types import Pose
from visctrl.planning.detours import WayFinder
from visctrl.planning.distance_field import DistanceField
from visctrl.planning.footprint import Footprint, along, along_many, trailed
from visctrl.planning.lattice_planner import Drive
from visctrl.planning.paths import path_between

OUTLINE = Footprint.of(ROBOT.body)
MARGIN = 0.12
DRIVE = Drive(0.12, 0.6)
FINDER = WayFinder(OUTLINE, AHEAD, MARGIN)
Disc = tuple[float, float, float]


@given(st.integers(0, 2**32))
def test_circles_cover_the_outline_and_little_more(seed: int) -> None:
    rng = np.random.default_rng(seed)
    discs = np.column_stack([rng.uniform(-1.0, 1.0, (20, 2)), rng.uniform(0.0, 0.1, 20)])
    pose = Pose(*rng.uniform(-1.0, 1.0, 2), rng.uniform(-4.0, 4.0))
    covered = OUTLINE.gaps(np.array(pose), discs)
    exact = gaps(pose, discs)
    outside = exact > 0.0
    assert np.all(covered[outside] <= exact[outside] + 1e-9)
    assert np.all(covered[outside] >= exact[outside] - 0.03)
    touching = ~outside & (exact > -0.1)
    assert np.all(covered[touching] <= 1e-9)


@given(st.integers(0, 2**32))
def test_the_distance_field_never_promises_too_much(seed: int) -> None:
    rng = np.random.default_rng(seed)
    discs = np.column_stack([rng.uniform(-3.0, 3.0, (5, 2)), rng.uniform(-0.1, 0.5, 5)])
    points = rng.uniform(-4.0, 4.0, (200, 2))
    middle = np.hypot(*(points[:, None] - discs[:, :2]).T).T
    exact = (middle - discs[:, 2]).min(axis=1)
    found = DistanceField(discs, 0.6).at(points)
    told = (middle.min(axis=1) > 0.1) & (exact < 0.6)
    assert np.all(found[told] <= exact[told] + 1e-9)
    # Midway between two discs the knots are nearer to either of them.
    assert np.all(found[told] >= exact[told] - 0.035)
    # Far away, nothing is said but that it is far.
    assert np.all(found[exact >= 0.6] > 0.55)


@pytest.mark.parametrize("heading", [-1.4, 0.0, 1.0])
def test_the_outline_trails_the_control_point_as_the_law_drives_it(heading: float) -> None:
    """Against the control law itself, (4.19), integrated in steps of a millimetre."""
    lever, path = 0.15, path_between((-1.0, -3.0), (0.0, 0.0), 0.6)
    foreseen = along(path, heading, lever, -3.0, 60)
    points = path.at_heights(np.linspace(-3.0, 0.0, 4000))
    phi = heading
    for step in np.diff(points, axis=0):
        phi -= (math.cos(phi) * step[0] + math.sin(phi) * step[1]) / lever
    assert foreseen[-1, 2] == pytest.approx(phi, abs=2e-3)
    middle = trailed(points[None], np.array([heading]), lever)[0]
    nearest = [np.hypot(*(middle[:, :2] - here).T).min() for here in foreseen[:, :2]]
    assert max(nearest) < 0.015


def test_many_paths_are_the_same_as_one_by_one() -> None:
    start, goal = np.array([[0.0, -3.0], [1.0, -2.0]]), np.array([[0.0, 0.0], [-0.4, 0.5]])
    many = along_many(start, goal, np.array([0.5, 0.5]), np.array([0.3, -0.3]), 0.1)
    for k, heading in enumerate((0.3, -0.3)):
        path = path_between(tuple(start[k]), tuple(goal[k]), 0.5)
        one = along(path, heading, 0.1, start[k, 1], many.shape[1])
        np.testing.assert_allclose(many[k], one, atol=1e-9)


def least_gap(pose: Pose, goals: list[tuple[float, float]], discs: list[Disc]) -> float:
    """Return how near the exact outline comes on a chain of paths."""
    found, here = math.inf, pose
    ahead = DRIVE.lever - AHEAD
    for x, y in goals:
        s, c = math.sin(here.phi), math.cos(here.phi)
        start = here.x - s * ahead, here.y + c * ahead
        path = path_between(start, (x, y + ahead), DRIVE.straight)
        for place in along(path, here.phi, DRIVE.lever, start[1], 200):
            found = min(found, float(gaps(Pose(*place), np.array(discs)).min()))
        here = Pose(x, y, 0.0)
    return found


@pytest.mark.parametrize("x", [-0.4, -0.05, 0.3])
def test_the_way_round_keeps_its_margin_all_along(x: float) -> None:
    here, discs = Pose(-0.3, -3.4, 0.0), [(x, -1.8, 0.29)]
    way = FINDER.way(here, (0.0, 0.0), np.array(discs), DRIVE, final=True, retreat=False)
    assert way
    assert least_gap(here, [*way, (0.0, 0.0)], discs) >= MARGIN


def test_two_obstacles_one_behind_the_other_are_passed_by_two_goals_where_one_is_not_enough() -> (
    None
):
    here = Pose(0.0, -5.0, 0.0)
    # A wall from the left, then one from the right: a slalom.
    discs = [(x, -3.4, 0.15) for x in np.arange(-6.0, 0.3, 0.25)]
    discs += [(x, -1.8, 0.15) for x in np.arange(-0.3, 6.0, 0.25)]
    way = FINDER.way(here, (0.0, 0.0), np.array(discs), DRIVE, final=True, retreat=False)
    assert way is not None
    assert len(way) >= 2
    assert least_gap(here, [*way, (0.0, 0.0)], discs) >= MARGIN


def test_no_way_round_is_said() -> None:
    wall = np.array([(x, -1.8, 0.3) for x in np.arange(-12.0, 12.0, 0.5)])
    here = Pose(-0.3, -3.4, 0.0)
    for retreat in (False, True):
        assert FINDER.way(here, (0.0, 0.0), wall, DRIVE, final=True, retreat=retreat) is None


def test_a_dead_end_is_left_by_turning_round() -> None:
    here = Pose(0.0, -3.0, 0.0)
    cup = [(x, -2.2, 0.1) for x in np.arange(-1.2, 1.3, 0.15)]
    cup += [(x, y, 0.1) for x in (-1.2, 1.2) for y in np.arange(-4.0, -2.2, 0.15)]
    discs = np.array(cup)
    assert FINDER.way(here, (0.0, 0.0), discs, DRIVE, final=True, retreat=False) is None
    way = FINDER.way(here, (0.0, 0.0), discs, DRIVE, final=True, retreat=True)
    assert way is not None
    assert way[0][1] < -4.0


def test_what_stands_by_the_target_does_not_keep_the_robot_away() -> None:
    """Walls 10 cm ahead of and beside a robot at the target: it stood there when it was taught."""
    x, y = ROBOT.body.width_m / 2 + 0.1, ROBOT.body.front_m - AHEAD + 0.1
    wall = np.array([(x, s, 0.0) for s in np.arange(-0.3, 0.2, 0.05)] + [(0.0, y, 0.0)])
    here = Pose(-0.6, -2.5, 0.0)
    assert FINDER.gaps((0.0, 0.0), wall).min() < MARGIN
    way = FINDER.way(here, (0.0, 0.0), wall, DRIVE, final=True, retreat=False)
    assert way is not None
    nearer = wall + np.array([0.0, 0.0, 0.2])
    assert FINDER.way(here, (0.0, 0.0), nearer, DRIVE, final=True, retreat=True) is None


def field(rng: np.random.Generator) -> tuple[tuple[float, float, float], list[Disc]]:
    """Return a start and up to ten obstacles, off the start and off the target's last metre."""
    start = (rng.uniform(-1.5, 1.5), rng.uniform(-6.0, -3.0), rng.uniform(-30.0, 30.0))
    discs = []
    for _ in range(rng.integers(1, 11)):
        x, y, radius = rng.uniform(-2.5, 2.5), rng.uniform(start[1], 0.5), rng.uniform(0.15, 0.5)
        from_target = math.hypot(x, y - min(max(y, -1.2), 0.0))
        if math.hypot(x - start[0], y - start[1]) > radius + 1.0 and from_target > radius + 0.6:
            discs.append((x, y, radius))
    return start, discs


def way_exists(start: tuple[float, float, float], discs: list[Disc]) -> bool:
    """Return whether a round robot that holds the real one gets through, with 20 cm to spare."""
    cell, room = 0.05, ROBOT.body.radius_m + 0.2
    x, y = np.arange(-7.0, 7.0, cell), np.arange(start[1] - 3.0, 3.0, cell)
    away = np.full((len(x), len(y)), np.inf)
    for disc in discs:
        here = np.hypot(x[:, None] - disc[0], y[None, :] - disc[1]) - disc[2]
        away = np.minimum(away, here)
    regions, _ = ndimage.label(away > room)
    first = axle(Pose(start[0], start[1], math.radians(start[2])))
    ends = [
        regions[round((p[0] - x[0]) / cell), round((p[1] - y[0]) / cell)]
        for p in (first, (0, -AHEAD))
    ]
    return bool(ends[0] == ends[1] != 0)


def test_random_fields_are_crossed_without_touching() -> None:
    """At 2 Hz, obstacles noticed at 0.8 m to 2 m: the outline never overlaps one.

    Every run arrives or stands blocked; where a way exists, nearly all arrive.
    """
    arrived, possible = 0, 0
    for seed in range(24):
        rng = np.random.default_rng(seed)
        start, discs = field(rng)
        listed = [
            {"x_m": x, "y_m": y, "radius_m": r, "noticed_m": rng.uniform(0.8, 2.0)}
            for x, y, r in discs
        ]
        watch = Watch(discs)
        settings = {
            **{f"start.{k}": v for k, v in zip(("x_m", "y_m", "phi_deg"), start, strict=True)},
            **{"seed": seed, "rate_hz": 2.0, "mock.noise_px": 0.5, "duration_s": 200.0},
            "obstacles": [{"name": "listed", "discs": listed}],
        }
        outcome = run(settings, watch)
        assert watch.nearest > 0.0, f"seed {seed} touches"
        reached = outcome.summary["status"] == "reached"
        assert reached or watch.phases[-1] == "blocked", f"seed {seed}: {outcome.summary['reason']}"
        if way_exists(start, discs):
            possible += 1
            arrived += reached
    assert possible >= 20
    assert arrived >= possible - 1


def test_an_obstacle_that_appears_while_another_is_passed() -> None:
    discs = [(-0.1, -3.0, 0.3), (-0.9, -1.8, 0.3)]
    noticed = (1.6, 0.9)
    watch = Watch(discs)
    listed = [
        {"x_m": x, "y_m": y, "radius_m": r, "noticed_m": n}
        for (x, y, r), n in zip(discs, noticed, strict=True)
    ]
    settings = {"start.x_m": -0.4, "start.y_m": -5.0, "start.phi_deg": 0.0, "duration_s": 150.0}
    outcome = run({**settings, "obstacles": [{"name": "listed", "discs": listed}]}, watch)
    assert outcome.summary["status"] == "reached", outcome.summary["reason"]
    assert watch.phases.count("stop") >= 2
    assert watch.nearest > 0.03


def test_a_robot_without_a_way_stands_and_says_so() -> None:
    wall = [{"x_m": 0.5 * k, "y_m": -1.8, "noticed_m": 9.0} for k in range(-24, 25)]
    settings = {"start.x_m": 0.0, "start.y_m": -3.5, "start.phi_deg": 0.0, "duration_s": 30.0}
    watch = Watch([(d["x_m"], d["y_m"], 0.3) for d in wall])
    outcome = run(
        {**settings, "rate_hz": 2.0, "obstacles": [{"name": "listed", "discs": wall}]}, watch
    )
    assert outcome.summary["status"] == "missed"
    assert watch.phases[-1] == "blocked"
    assert watch.nearest > 0.5
