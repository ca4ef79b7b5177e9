"""The remaining error from bearings: recovered, with a doubt that is right, whatever moved."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from visctrl.hal.types import Pose
from visctrl.schemes.arrival.depths import Waypoint, composed, measured_depths, relative_to
from visctrl.schemes.arrival.displacement import Depths, Sighting, displacement

Array = NDArray[np.float64]

HERE = Pose(0.0, 0.0, 0.0)
small = st.floats(-0.1, 0.1)
poses = st.builds(Pose, small, small, st.floats(-0.3, 0.3))


def scene(rng: np.random.Generator, count: int = 60) -> Array:
    """Return points (right, forward, up) about the target, 1.5 to 8 m away."""
    bearing, far = rng.uniform(-np.pi, np.pi, count), rng.uniform(1.5, 8.0, count)
    return np.stack([far * np.sin(bearing), far * np.cos(bearing), rng.uniform(-0.7, 2, count)], -1)


def cast(points: Array, pose: Pose, rng: np.random.Generator | None = None, sd: float = 0) -> Array:
    """Return the rays of points from a pose: turned into its frame, not by the code under test."""
    c, s = math.cos(pose.phi), math.sin(pose.phi)
    away = points - np.array([pose.x, pose.y, 0.0])
    local = np.stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]], axis=-1)
    rays = np.column_stack([local, away[:, 2]])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    if rng is not None:
        rays = rays + sd * rng.standard_normal(rays.shape)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays


def sighting(rays: Array, sd: float) -> Sighting:
    return Sighting(rays, np.broadcast_to(np.eye(2) / sd, (len(rays), 2, 2)))


def exact_depths(points: Array) -> Depths:
    inverse = 1.0 / np.linalg.norm(points, axis=1)
    return Depths(inverse, 1e-6 * inverse, np.zeros(len(points), dtype=np.bool_), 1e-6)


@settings(max_examples=40, deadline=None)
@given(pose=poses, seed=st.integers(0, 1000))
def test_exact_bearings_and_depths_give_the_pose(pose: Pose, seed: int) -> None:
    points = scene(np.random.default_rng(seed))
    seen = sighting(cast(points, pose), 1e-5)
    found = displacement(cast(points, HERE), seen, exact_depths(points))
    assert found.pose == pytest.approx(pose, abs=1e-6)


@settings(max_examples=20, deadline=None)
@given(turn=st.floats(-3.0, 3.0), seed=st.integers(0, 1000))
def test_a_turn_on_the_spot_needs_no_depth(turn: float, seed: int) -> None:
    points = scene(np.random.default_rng(seed))
    found = displacement(cast(points, HERE), sighting(cast(points, Pose(0, 0, turn)), 1e-5))
    assert found.pose == pytest.approx(Pose(0.0, 0.0, turn), abs=1e-6)


@pytest.mark.parametrize("measured", [False, True], ids=["depths unknown", "from the way"])
def test_the_doubt_is_right(measured: bool) -> None:
    """Two standard deviations hold nine in ten and more, wheels that are 10 % wrong included.

    Where nothing tells the scale it is on the safe side.
    """
    rng, sd, inside = np.random.default_rng(4), 0.003, []
    for _ in range(30 if measured else 100):
        points = scene(rng)
        pose = Pose(*rng.normal(0.0, 0.015, 2).tolist(), float(rng.normal(0.0, 0.01)))
        target = cast(points, HERE, rng, sd)
        seen = sighting(cast(points, pose, rng, sd), math.sqrt(2.0) * sd)
        depths = None
        if measured:
            wheels = 1.0 + 0.1 * rng.standard_normal()
            way = [Pose(0.1 * r, -r, 0.1 * r) for r in (0.2, 0.5, 1.0, 2.0)]
            earlier = [
                Waypoint(
                    sighting(cast(points, composed(pose, at), rng, sd), math.sqrt(2.0) * sd),
                    Pose(wheels * at.x, wheels * at.y, at.phi + 0.02 * rng.standard_normal()),
                )
                for at in way
            ]
            depths = measured_depths(target, seen, earlier, HERE)
        found = displacement(target, seen, depths)
        inside += list(
            np.abs(np.subtract(found.pose, pose)) < 2.0 * np.sqrt(found.covariance.diagonal())
        )
    assert np.mean(inside) >= 0.9
    if measured:
        assert np.mean(inside) <= 0.995


def test_views_on_the_way_measure_depths() -> None:
    rng, sd = np.random.default_rng(2), 0.002
    points, pose = scene(rng), Pose(0.004, -0.006, 0.002)
    way = [Pose(0.1 * r, -r, 0.1 * r) for r in (0.2, 0.5, 1.0, 2.0)]
    earlier = [Waypoint(sighting(cast(points, composed(pose, at), rng, sd), sd), at) for at in way]
    target, seen = cast(points, HERE, rng, sd), sighting(cast(points, pose, rng, sd), sd)
    found = measured_depths(target, seen, earlier, HERE)
    true = 1.0 / np.linalg.norm(points, axis=1)
    assert np.median(np.abs(found.mean / true - 1.0)) < 0.05
    assert (
        np.mean(np.abs(found.mean - true) < 3.0 * np.hypot(found.sd, true * found.scale_sd)) > 0.95
    )


@pytest.mark.parametrize("share", [0.2, 0.35])
def test_what_has_moved_does_not_count(share: float) -> None:
    rng = np.random.default_rng(7)
    points, pose = scene(rng, 100), Pose(0.01, -0.005, 0.01)
    now = points.copy()
    moved = rng.permutation(100)[: round(100 * share)]
    now[moved, :2] += rng.uniform(0.2, 0.5, (len(moved), 2))
    seen = sighting(cast(now, pose, rng, 1e-3), math.sqrt(2.0) * 1e-3)
    found = displacement(cast(points, HERE, rng, 1e-3), seen, exact_depths(points))
    assert found.distance == pytest.approx(math.hypot(pose.x, pose.y), abs=0.004)
    still = np.setdiff1d(np.arange(100), moved)
    assert np.mean(found.residuals[still] < 4.0) > 0.9
    assert np.mean(found.residuals[moved] < 4.0) < 0.3


def test_without_any_scale_a_distance_is_not_called_small() -> None:
    """Far things: 5 cm look like a few millimetres, and the doubt says so."""
    points = 5.0 * scene(np.random.default_rng(1), 200)
    rng = np.random.default_rng(3)
    seen = sighting(cast(points, Pose(0.05, 0.0, 0.0), rng, 1e-4), math.sqrt(2.0) * 1e-4)
    found = displacement(cast(points, HERE, rng, 1e-4), seen)
    assert found.distance < 0.03
    assert found.distance + 2.0 * found.distance_sd > 0.05


def test_a_distance_without_scale_is_some_distance() -> None:
    points = scene(np.random.default_rng(1), 200)
    seen = sighting(cast(points, Pose(0.9, 0.0, 0.0)), 1e-3)
    assert displacement(cast(points, HERE), seen).least_distance(2.0) > 0.02


@given(a=st.builds(Pose, small, small, small), b=st.builds(Pose, small, small, small))
def test_relative_poses_compose(a: Pose, b: Pose) -> None:
    assert composed(a, relative_to(a, b)) == pytest.approx(b, abs=1e-12)


def test_features_that_determine_nothing_are_no_fault() -> None:
    """One and the same ray many times, in both fits: all that comes of it is a large doubt."""
    ray = np.tile([0.0, 1.0, 0.0], (20, 1))
    found = displacement(ray, sighting(ray, 1e-3))
    assert found.distance_sd > 1.0
    earlier = [Waypoint(sighting(ray, 1e-3), Pose(0.0, -0.5, 0.0))]
    assert np.isfinite(measured_depths(ray, sighting(ray, 1e-3), earlier, HERE).mean).all()
