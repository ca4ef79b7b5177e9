"""The two motions of a calibrated tensor: both reproduce it, one of them is the true one."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from three_views import TARGET, random_poses, rays_seen, scene

from visctrl.geometry.trifocal import tensor as trifocal
from visctrl.geometry.trifocal.motions import motions_of_tensor, share_in_front
from visctrl.robots.unicycle import wrap_angle

seeds = st.integers(0, 10_000)


def tensors(motions):
    views = [trifocal.view_parameters(m[..., 0], m[..., 1:]) for m in np.moveaxis(motions, -2, 0)]
    return trifocal.tensor_of_views(*views)


@given(seeds)
@settings(max_examples=50)
def test_every_motion_reproduces_the_tensor(seed):
    initial, current = random_poses(np.random.default_rng(seed))
    T = trifocal.tensor_from_poses(initial, current)
    rebuilt = tensors(motions_of_tensor(T))
    unit = T / np.linalg.norm(T)
    rebuilt /= np.linalg.norm(rebuilt, axis=-1, keepdims=True)
    sign = np.sign(rebuilt @ unit)[:, None]
    # The triangle's closing angle loses half of the digits where it is flat.
    np.testing.assert_allclose(rebuilt * sign, np.broadcast_to(unit, (16, 8)), atol=1e-6)


@given(seeds)
@settings(max_examples=50)
def test_the_true_motion_is_one_that_lies_in_front(seed):
    rng = np.random.default_rng(seed)
    initial, current = random_poses(rng)
    # Points stay clear of the way, so that none is beside a view.
    points = scene(rng, 40, 8.0, 15.0)
    views = [rays_seen(points, pose) for pose in (initial, current, TARGET)]
    motions = motions_of_tensor(trifocal.tensor_from_poses(initial, current))
    front = share_in_front(motions, *views)
    unit = np.hypot(*initial[:2])
    expected = np.array(
        [[pose[2], *(trifocal.target_in_view(pose) / unit)] for pose in (initial, current)]
    )
    difference = motions - expected
    difference[..., 0] = wrap_angle(difference[..., 0])
    distance = np.abs(difference).max(axis=(1, 2))
    assert distance.min() < 1e-5
    assert front[distance.argmin()] == 1.0
    # Of the eight choices of sign for each way to close the triangle, at most one is physical.
    assert (front[:8] > 0.5).sum() <= 1
    assert (front[8:] > 0.5).sum() <= 1
