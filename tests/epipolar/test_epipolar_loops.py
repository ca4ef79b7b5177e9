"""Closed loops: epipoles estimated from image points, exact unicycle, no limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from epipolar_world import PERSPECTIVE, Run, World, context, drive

from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.schemes.epipolar.estimator import Epipoles, EpipolesOptions
from visctrl.schemes.epipolar.law_smc import EpipolarSmc, EpipolarSmcOptions
from visctrl.schemes.epipolar.law_smooth import EpipolarSmooth, EpipolarSmoothOptions

Start = tuple[float, float, float]
TABLE = [(4, -8, 40), (3, -11, 15.26), (-5, -13, 0), (-7, -18, -10)]


def smooth(
    start: Start,
    duration: float = 20.0,
    camera: CentralCamera = PERSPECTIVE,
    believed: CentralCamera | None = None,
    longest: float | None = None,
    **world: float,
) -> Run:
    x, y, degrees = start
    scene = World((x, y, math.radians(degrees)), camera, believed, **world)
    told = context(believed or camera, scene.seed)
    controller = EpipolarSmooth(EpipolarSmoothOptions(duration_s=duration), told)
    return drive(scene, Epipoles(EpipolesOptions(), told), controller, longest or duration + 0.1)


def source(start: Start, duration: float = 20.0, **world: float) -> Run:
    x, y, degrees = start
    scene = World((x, y, math.radians(degrees)), **world)
    told = context(PERSPECTIVE, scene.seed)
    estimator = Epipoles(EpipolesOptions(aligned_after_s=0.8 * duration), told)
    law = EpipolarSmc(EpipolarSmcOptions(duration_s=duration), told)
    return drive(scene, estimator, law, duration)


@pytest.mark.parametrize(
    ("start", "published"),
    list(zip(TABLE, [(0.53, 0.08), (0.16, 0.04), (2.84, 0.01), (4.10, 0.02)], strict=True)),
)
def test_nearer_to_the_target_than_published(start: Start, published: tuple[float, float]) -> None:
    run = smooth(start)
    assert run.finished
    assert abs(run.error[0]) <= 0.1
    assert (abs(run.error[1]), abs(run.error[2])) <= published
    assert abs(run.error[2]) <= published[1]
    assert np.abs(run.inputs[:, 0]).max() < 4.0
    assert np.abs(run.inputs[:, 1]).max() < 2.0


def test_a_tenth_of_the_sources_chatter() -> None:
    published, ours = source(TABLE[0]), smooth(TABLE[0])
    assert published.chatter > 4.0
    assert ours.chatter <= 0.1 * published.chatter


def test_noise_of_half_a_pixel_from_a_far_start() -> None:
    run = smooth(TABLE[2], noise_px=0.5, seed=910)
    assert np.abs(run.error[:2]).max() < 6.0
    assert abs(run.error[2]) < 0.5
    # The source's law on exact epipoles varies by 4.7 to 5.5 rad/s there.
    assert run.chatter < 0.45


@pytest.mark.parametrize("focal", [200.0, 1000.0])
def test_a_wrong_focal_length(focal: float) -> None:
    camera = PERSPECTIVE.altered(fx=focal, fy=focal)
    run = smooth((2, -7, 30), camera=camera, believed=PERSPECTIVE)
    assert np.abs(run.error[:2]).max() <= 2.0
    assert abs(run.error[2]) <= 0.5


@pytest.mark.parametrize("shift", [20.0])
def test_a_wrong_centre(shift: float) -> None:
    camera = PERSPECTIVE.altered(cx=PERSPECTIVE.cx + shift)
    run = smooth((2, -7, 30), camera=camera, believed=PERSPECTIVE)
    assert np.abs(run.error[:2]).max() <= 2.0
    assert abs(run.error[2]) <= 0.5


@pytest.mark.parametrize(
    ("start", "camera"),
    [
        ((-4, -14, 0), "paracatadioptric"),
        ((8, -16, 10), "fisheye"),
        ((2.5, -12, 11.77), "hypercatadioptric"),
    ],
)
def test_omnidirectional_cameras(start: Start, camera: str) -> None:
    run = smooth(start, 20.0, load_camera(camera))
    assert np.abs(run.error[:2]).max() <= 0.2
    assert abs(run.error[2]) <= 0.1


@pytest.mark.parametrize("camera", ["paracatadioptric", "fisheye"])
def test_noise_costs_an_omnidirectional_far_start_little(camera: str) -> None:
    """By the epipoles' lines alone it is 3 to 10 cm: they meet at a flat angle."""
    runs = (
        smooth((-4, -14, 0), 20.0, load_camera(camera), noise_px=0.5, seed=seed) for seed in (3, 4)
    )
    errors = np.abs([run.error for run in runs])
    assert errors[:, :2].max() <= 1.5
    assert errors[:, 2].mean() <= 0.4


@pytest.mark.parametrize(
    ("start", "camera", "kind"),
    [
        ((0, -3, 0), "perspective", "aligned"),
        ((2, -0.3, 0), "hypercatadioptric", "lateral"),
        ((0, 2, 0), "hypercatadioptric", "behind"),
    ],
)
def test_manoeuvres_lead_to_a_start_that_the_direct_motion_serves(
    start: Start, camera: str, kind: str
) -> None:
    run = smooth(start, 20.0, load_camera(camera), longest=50.0)
    assert run.phases[0] == f"manoeuvre-{kind}"
    assert run.finished
    assert np.abs(run.error[:2]).max() <= 0.5
    assert abs(run.error[2]) <= 0.2


def test_the_robot_does_not_move_on_garbage() -> None:
    """A scene of which the camera sees too little: named, and not driven on."""
    run = smooth((2, -6, 10), duration=2.0, count=6)
    assert not run.inputs.any()
    assert run.estimates[0].reason == "6 features"
