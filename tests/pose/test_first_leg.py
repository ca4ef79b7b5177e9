"""Where the robot started, from the first leg: found whatever the start, and judged fairly."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from visctrl.schemes.pose.first_leg import Leg
from visctrl.schemes.pose.leg_start import LegSolution, solve_leg

DATA = Path(__file__).parents[1] / "data"
SIGMA = 4e-4
FRAMES, LENGTH_M = 27, 0.2
#: A fisheye lens sees half of the room.
FIELD = math.radians(90.0)


def bearing(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return the bearings (N,) of points (N, 2) from a pose (rad), clockwise from forward."""
    d = points - pose[:2]
    angle = np.arctan2(d[:, 0], d[:, 1]) + pose[2]
    return np.asarray(np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi)


def leg_from(pose: np.ndarray, seed: int) -> Leg:
    """Return what a robot sees that drives ahead from ``pose`` in a room of 8 m by 10 m."""
    rng = np.random.default_rng(seed)
    u, wall = rng.uniform(-1.0, 1.0, 400), rng.integers(0, 4, 400)
    x = np.choose(wall, [4.0 * u, 4.0 * u, np.full(400, 4.0), np.full(400, -4.0)])
    y = np.choose(wall, [np.full(400, 4.0), np.full(400, -6.0), 5.0 * u - 1.0, 5.0 * u - 1.0])
    points = np.stack([x, y], axis=-1) + rng.normal(0.0, 0.2, (400, 2))
    fixed = [bearing(points, pose), bearing(points, np.zeros(3))]
    both = np.flatnonzero((np.abs(fixed[0]) < FIELD) & (np.abs(fixed[1]) < FIELD))[:60]
    way = np.linspace(0.0, LENGTH_M, FRAMES)
    ahead = np.array([-math.sin(pose[2]), math.cos(pose[2])])
    seen = np.stack([bearing(points[both], np.append(pose[:2] + s * ahead, pose[2])) for s in way])
    noise = rng.normal(0.0, SIGMA, (FRAMES + 2, len(both)))
    return Leg(
        theta1=fixed[0][both] + noise[0],
        theta3=fixed[1][both] + noise[1],
        sigma1=np.full(len(both), SIGMA),
        sigma3=np.full(len(both), SIGMA),
        motion=np.stack([np.zeros(FRAMES), way, np.zeros(FRAMES)], axis=-1),
        turn_variance=np.linspace(0.0, 1e-6, FRAMES),
        theta2=seen + noise[2:],
        sigma2=np.full(seen.shape, SIGMA),
    )


def starts(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    low, high = [-1.5, -3.5, math.radians(-30.0)], [1.5, -1.4, math.radians(30.0)]
    return list(rng.uniform(low, high, (count, 3)))


def turned(found: LegSolution, pose: np.ndarray) -> float:
    """Return how far the direction of C1 is off (rad)."""
    return abs(math.remainder(found.beta - math.atan2(pose[0], -pose[1]), math.tau))


def test_the_start_is_found_from_anywhere_in_half_a_room() -> None:
    for seed, pose in enumerate(starts(40)):
        found = solve_leg(leg_from(pose, seed))
        assert found is not None
        assert turned(found, pose) < 0.1, (seed, pose)
        assert found.q * math.hypot(*pose[:2]) == pytest.approx(1.0, abs=0.1)


def recorded(name: str) -> tuple[np.ndarray, Leg]:
    """Return the true start and the first leg of a P3-AT with the fisheye in the rendered hall."""
    with np.load(DATA / f"first_leg_{name}.npz") as file:
        parts = {key: file[key].astype(np.float64) for key in file.files}
    return parts.pop("start"), Leg(**parts)


def test_many_places_to_begin_from_are_tried() -> None:
    """From 3 m, seeing 60 features on few walls, the eight that look best all end elsewhere."""
    pose, leg = recorded("far")
    few = solve_leg(leg, starts=8)
    assert few is not None
    found = solve_leg(leg)
    assert found is not None
    assert few.cost > 1.5 * found.cost
    assert turned(few, pose) > 3.0 * turned(found, pose)
    assert turned(found, pose) < 0.02
    assert found.q * math.hypot(*pose[:2]) == pytest.approx(1.0, abs=0.01)


def test_features_that_cannot_tell_do_not_count_against_the_solution() -> None:
    """Half of them lie near the baseline, where they say nothing, though they were seen well."""
    pose, leg = recorded("near")
    found = solve_leg(leg)
    assert found is not None
    assert turned(found, pose) < 0.01
    assert found.used.sum() < 0.5 * len(found.used)
    assert found.used.sum() >= 0.9 * found.tested.sum()
    assert not (found.used & ~found.tested).any()
