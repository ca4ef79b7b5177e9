"""The horizon's row, found from two views of a robot in the plane."""

from __future__ import annotations

import math

import numpy as np
import pytest
from epipolar_world import PERSPECTIVE, World, context, drive

from visctrl.geometry.two_view.horizon import Horizon, find_horizon
from visctrl.schemes.epipolar.estimator import Epipoles, EpipolesOptions
from visctrl.schemes.epipolar.law_smooth import EpipolarSmooth, EpipolarSmoothOptions

START = (2.0, -7.0, math.radians(30.0))
WIDEST = 0.052


def horizon(row_px: float, noise_px: float, seed: int, start=START, outliers=0.0) -> Horizon:
    """Return what is found with the centre row off by ``row_px``."""
    camera = PERSPECTIVE.altered(cy=PERSPECTIVE.cy + row_px)
    world = World(start, camera, PERSPECTIVE, noise_px, seed, outliers=outliers)
    views = world.views(start, 0.0)
    a, b = (rays[:, [0, 2]] / rays[:, 1:2] for rays in (views.initial, views.target))
    return find_horizon(a, b, 0.5 / PERSPECTIVE.fx, WIDEST, seed=seed)


@pytest.mark.parametrize("row_px", [-20.0, 0.0, 7.3])
def test_the_row_is_exact_without_noise(row_px: float) -> None:
    found = -horizon(row_px, 0.0, 1).shift * PERSPECTIVE.fy
    # The search ends a 160th of its width from the truth.
    assert found == pytest.approx(row_px, abs=2 * WIDEST * PERSPECTIVE.fy / 320)


def test_noise_and_outliers_cost_about_a_pixel_and_the_deviation_says_how_much() -> None:
    errors, scaled = [], []
    for seed in range(8):
        found = horizon(12.0, 0.5, seed, outliers=0.15)
        errors.append(abs(-found.shift - 12.0 / PERSPECTIVE.fy))
        scaled.append(errors[-1] / found.sd)
    assert np.median(errors) * PERSPECTIVE.fy < 0.6
    assert max(errors) * PERSPECTIVE.fy < 2.0
    assert 0.1 < np.median(scaled) < 2.0


def test_identical_views_tell_no_row() -> None:
    assert horizon(10.0, 0.5, 2, start=(0.0, -1e-3, 0.0)).sd > 0.01


def test_a_wrong_centre_row_costs_nothing_once_it_is_found() -> None:
    """With the row trusted this run ends five metres off."""
    camera = PERSPECTIVE.altered(cy=PERSPECTIVE.cy + 20.0)
    world = World(START, camera, PERSPECTIVE)
    told = context(PERSPECTIVE)
    law = EpipolarSmooth(EpipolarSmoothOptions(duration_s=20.0), told)
    run = drive(world, Epipoles(EpipolesOptions(), told), law, 20.1)
    assert np.abs(run.error[:2]).max() < 1.0
    assert abs(run.error[2]) < 0.1
