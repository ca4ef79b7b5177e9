"""The unicycle's exact Jacobians and the composition of poses."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from visctrl.robots.unicycle import arc, compose, exact_jacobians, relative_pose, step_exact

SEEDS = st.integers(0, 2**32 - 1)


@given(st.floats(-1, 1), st.floats(-3, 3), st.floats(0.01, 1), st.floats(0, 0.3), SEEDS)
def test_exact_jacobians_are_those_of_differences(
    v: float, omega: float, dt: float, offset: float, seed: int
) -> None:
    pose = np.random.default_rng(seed).uniform(-3, 3, 3)
    F, G = exact_jacobians(pose, v, omega, dt, offset)
    h = 1e-6
    for k, step in enumerate(h * np.eye(3)):
        ends = [step_exact(pose + s * step, v, omega, dt, offset) for s in (1, -1)]
        assert_allclose(F[:, k], (ends[0] - ends[1]) / (2 * h), atol=1e-8)
    for k, (dv, dw) in enumerate([(h, 0.0), (0.0, h)]):
        ends = [step_exact(pose, v + s * dv, omega + s * dw, dt, offset) for s in (1, -1)]
        assert_allclose(G[:, k], (ends[0] - ends[1]) / (2 * h), atol=1e-7)


@given(
    st.floats(-4, 4), st.floats(-1, 1), st.floats(-3, 3), st.floats(0.01, 1), st.floats(-0.3, 0.3)
)
def test_the_arc_of_one_pose_is_that_of_the_arrays(
    phi: float, v: float, omega: float, dt: float, offset: float
) -> None:
    pose = np.array([0.0, 0.0, phi])
    F, G = exact_jacobians(pose, v, omega, dt, offset)
    found = arc(phi, v, omega, dt, offset)
    expected = step_exact(pose, v, omega, dt, offset) - pose
    assert_allclose([found.dx, found.dy, found.turn], expected, atol=1e-12)
    assert_allclose(np.reshape(found.by_velocity, (2, 2)), G[:2], atol=1e-10)
    assert_allclose([-found.dy, found.dx, 0.0], F[:, 2] - [0.0, 0.0, 1.0], atol=1e-12)


@given(SEEDS)
def test_compose_undoes_relative_pose(seed: int) -> None:
    a, b = np.random.default_rng(seed).uniform(-3, 3, (2, 3))
    assert_allclose(compose(b, relative_pose(a, b))[:2], a[:2], atol=1e-12)
