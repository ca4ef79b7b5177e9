"""Where the tensor is hardly determined: short baselines, clusters, a start on the target."""

import math

import numpy as np
import pytest
from drives import PERIOD, SIGMA, TARGET, Drive, context, rays

from visctrl.contracts import Health
from visctrl.geometry.trifocal.tensor import normalised, tensor_from_poses
from visctrl.hal.types import STANDSTILL, Velocity
from visctrl.schemes.trifocal.estimator import Tensor
from visctrl.schemes.trifocal.tensor_method import TensorOptions

START = (-0.55, -1.35, -0.45)
ONWARDS = Velocity(0.2, 0.05)


def estimate_after(drive, ticks, **options):
    plugin = Tensor(TensorOptions(**options), context())
    plugin.update(drive.views(), STANDSTILL, 0.0)
    for _ in range(ticks):
        drive.step(ONWARDS)
    return plugin.update(drive.views(), ONWARDS, ticks * PERIOD)


def test_a_short_baseline_does_not_look_better_known_than_it_is():
    """Ten centimetres: noise alone makes information, which the covariance must leave out."""
    errors, promised = [], []
    for seed in range(30):
        drive = Drive(START, seed=seed, sigma=SIGMA)
        estimate = estimate_after(drive, 5, method="refined")
        truth = normalised(tensor_from_poses(np.array(START), drive.pose))
        errors.append(np.linalg.norm(estimate.elements - truth))
        promised.append(math.sqrt(np.trace(estimate.covariance)))
    assert np.median(errors) < 1.2 * np.median(promised)
    assert np.median(errors) > 0.4 * np.median(promised)


def clustered(width_deg, seed):
    """Return a drive whose features all lie within ±``width_deg`` ahead of the target."""
    drive = Drive(START, seed=seed, sigma=SIGMA, count=40)
    rng = np.random.default_rng(seed)
    azimuth = np.radians(rng.uniform(-width_deg, width_deg, 40))
    reach, height = rng.uniform(3.0, 5.0, 40), rng.uniform(-0.1, 0.1, 40)
    drive.points = np.stack([reach * np.sin(azimuth), reach * np.cos(azimuth), height], axis=-1)
    drive.target = rays(drive.points, TARGET, drive.rng, SIGMA)
    drive.initial = rays(drive.points, drive.pose, drive.rng, SIGMA)
    return drive


@pytest.mark.parametrize("method", ["constrained", "refined", "linear5", "linear7"])
def test_clustered_features_are_refused_by_name(method):
    for seed in range(4):
        estimate = estimate_after(clustered(2.0, seed), 10, method=method)
        assert estimate.health is Health.DEGENERATE
        assert "clustered" in estimate.reason or "identical" in estimate.reason


@pytest.mark.parametrize("method", ["refined", "linear5", "linear7"])
def test_too_few_features_for_the_unknowns_are_named(method):
    needed = 8 if method == "linear7" else 6
    drive = Drive(START, sigma=SIGMA)
    plugin = Tensor(TensorOptions(method=method, min_features=5), context())
    estimate = plugin.update(drive.views(keep=slice(0, needed - 1)), STANDSTILL, 0.0)
    assert estimate.health is Health.LOST
    assert f"{needed} are needed" in estimate.reason


def test_a_start_that_cannot_be_told_from_the_target_counts_as_the_target():
    """Two centimetres with 4 mrad of noise: nothing to drive by, and so no driving off."""
    for seed in range(5):
        drive = Drive((0.0, -0.02, 0.3), seed=seed, sigma=4e-3)
        estimate = Tensor(TensorOptions(), context()).update(drive.views(), STANDSTILL, 0.0)
        assert estimate.health is Health.OK
        assert np.abs(estimate.outputs).max() < 1e-9
        assert estimate.heading == pytest.approx(0.3, abs=math.radians(0.5))
