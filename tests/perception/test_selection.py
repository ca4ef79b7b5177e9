from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from visctrl.perception.selection import spread

SHAPE = (100, 400)


@given(st.integers(0, 300), st.integers(1, 100), st.integers(0, 99))
def test_as_many_as_wanted_each_once(total, count, seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform([0, 0], [400, 100], (total, 2))
    chosen = spread(points, rng.random(total), count, SHAPE)
    assert len(chosen) == min(total, count) == len(set(chosen.tolist()))


def test_a_cluster_does_not_crowd_out_the_rest():
    rng = np.random.default_rng(1)
    cluster = rng.uniform([10, 10], [30, 30], (200, 2))
    rest = rng.uniform([0, 0], [400, 100], (40, 2))
    points = np.concatenate([cluster, rest])
    quality = np.r_[np.full(200, 1.0), np.full(40, 0.1)]
    chosen = spread(points, quality, 40, SHAPE)
    by_quality = np.argsort(-quality)[:40]
    assert np.count_nonzero(chosen >= 200) >= 20
    assert np.ptp(points[chosen, 0]) > 300 > np.ptp(points[by_quality, 0])


def test_the_best_of_a_cell_comes_before_its_others():
    points = np.array([[5.0, 5.0], [6.0, 6.0], [200.0, 50.0]])
    assert spread(points, [0.2, 0.9, 0.1], 2, SHAPE).tolist() == [1, 2]


def test_features_on_a_small_part_of_the_image_are_still_spread_over_that_part():
    rng = np.random.default_rng(2)
    pairs = rng.uniform([100, 20], [260, 80], (150, 2)).repeat(2, axis=0)
    points = pairs + rng.uniform(0, 1, pairs.shape)
    chosen = points[spread(points, rng.random(300), 60, SHAPE)]
    gaps = np.linalg.norm(chosen[:, None] - chosen[None], axis=-1) + 1e9 * np.eye(60)
    assert np.mean(gaps.min(axis=1) < 2.0) < 0.1
