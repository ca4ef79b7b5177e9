"""The current view placed between the target and the reference by the features' parallax."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from visctrl.schemes.epipolar.position import Placed, Structure

Pose = tuple[float, float, float]
REFERENCE: Pose = (math.sin(0.3), -math.cos(0.3), -0.2)


def rays_from(pose: Pose, points: np.ndarray) -> np.ndarray:
    x, y, phi = pose
    d = points - [x, y, 0.0]
    c, s = math.cos(phi), math.sin(phi)
    turned = np.stack([c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1], d[:, 2]], -1)
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))


def scene(rng: np.random.Generator, count: int = 80) -> np.ndarray:
    angle, reach = rng.uniform(-np.pi, np.pi, count), rng.uniform(0.3, 1.2, count)
    up = rng.uniform(-0.2, 0.2, count)
    return np.stack([reach * np.sin(angle), reach * np.cos(angle) - 0.4, up], -1)


def views(pose: Pose, seed: int, sigma: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    points = scene(rng)
    found = [rays_from(p, points) for p in ((0.0, 0.0, 0.0), REFERENCE, pose)]
    noisy = [r + rng.normal(0.0, sigma, r.shape) for r in found]
    a, b, c = (r / np.linalg.norm(r, axis=1, keepdims=True) for r in noisy)
    return a, b, c


def place_view(
    rays: tuple[np.ndarray, np.ndarray, np.ndarray], reference: Pose, start: Pose, sigma: float
) -> Placed | None:
    """Place the current view by rays (N, 3) of target, reference and current view."""
    target, other, current = (view.T for view in rays)
    return Structure(np.array([target, other]), reference).place(current, start, sigma)


def error_of(placed: Placed | None, pose: Pose) -> np.ndarray:
    assert placed is not None
    return np.array([placed.x - pose[0], placed.y - pose[1]])


@given(
    st.tuples(st.floats(-0.4, 0.4), st.floats(-0.9, 0.2), st.floats(-0.6, 0.6)),
    st.integers(0, 500),
)
@settings(max_examples=50, deadline=None)
def test_exact_rays_place_the_view_exactly(pose: Pose, seed: int) -> None:
    start = (pose[0] + 0.02, pose[1] - 0.02, pose[2] + 1e-3)
    rays = views(pose, seed)
    placed = place_view(rays, REFERENCE, start, 1e-5)
    for _ in range(3):
        assert placed is not None
        placed = place_view(rays, REFERENCE, (placed.x, placed.y, pose[2]), 1e-5)
    assert np.abs(error_of(placed, pose)).max() < 1e-7


def test_deviations_are_those_of_the_errors_near_the_target() -> None:
    sigma, scaled = 1e-3, []
    pose = (0.001, -0.003, 0.02)
    for seed in range(60):
        placed = place_view(views(pose, seed, sigma), REFERENCE, pose, sigma)
        error = error_of(placed, pose)
        assert placed is not None
        xx, xy, yy = placed.variance
        scaled.append(float(error @ np.linalg.solve([[xx, xy], [xy, yy]], error)) / 2.0)
    assert 0.6 < np.mean(scaled) < 1.6


def test_a_wrong_turn_and_wrong_ranges_do_not_move_the_target() -> None:
    """At the target the images coincide: neither the turn nor the structure may matter there."""
    pose = (0.0, 0.0, 0.0)
    target, _, current = views(pose, 1)
    wrong = views((0.0, 0.0, 0.0), 1)[1]
    bent = np.stack([wrong[:, 0] + 0.05 * wrong[:, 1], wrong[:, 1], 1.1 * wrong[:, 2]], -1)
    bent /= np.linalg.norm(bent, axis=1, keepdims=True)
    placed = place_view((target, bent, current), REFERENCE, (0.01, -0.02, 0.004), 1e-4)
    assert np.abs(error_of(placed, pose)).max() < 2e-4


def test_gross_errors_hardly_matter() -> None:
    sigma, pose = 1e-3, (0.02, -0.1, 0.0)
    target, reference, current = views(pose, 3, sigma)
    wrong = np.random.default_rng(0).normal(size=(12, 3))
    current[:12] = wrong / np.linalg.norm(wrong, axis=1, keepdims=True)
    placed = place_view((target, reference, current), REFERENCE, (0.0, -0.1, 0.0), sigma)
    assert np.abs(error_of(placed, pose)).max() < 2e-3


def test_too_few_or_too_distant_features_place_nothing() -> None:
    target, reference, current = views((0.0, -0.2, 0.0), 2)
    few = (target[:6], reference[:6], current[:6])
    assert place_view(few, REFERENCE, (0.0, -0.2, 0.0), 1e-4) is None
    # So much noise that no range is known.
    assert place_view((target, reference, current), REFERENCE, (0.0, -0.2, 0.0), 1.0) is None
