"""Whether a first match is the only one: noise, wrong calibrations, moved things, equal places."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from visctrl.geometry.two_view.planar import refine_planar_motion
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.perception.ambiguity import (
    FEWEST_DISTINCTIVE,
    MOST_DISAGREEMENT,
    Evidence,
    disagreement,
)
from visctrl.perception.calibration_doubt import explained_by_calibration
from visctrl.perception.patch_noise import pixel_noise, position_deviations
from visctrl.perception.unwrap import FlatCanvas, canvas_for
from visctrl.reproduce import matches

CAMERA = load_camera("hypercatadioptric").resized(800, 600)
SIGMA = 0.1 / CAMERA.pixels_per_radian
PHI, AT = 0.3, np.array([-0.5, -1.6])


def views(seed: int, moved: float = 0.0, centre: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return rays (N, 3) of points seen from the target and from `AT`, noise included.

    moved : share of the points that have another place in the second view. centre : by how much
    (px) the camera's image centre is off, which the rays do not know.
    """
    rng = np.random.default_rng(seed)
    bearing, distance = rng.uniform(-math.pi, math.pi, 90), rng.uniform(2.0, 9.0, 90)
    points = np.stack(
        [distance * np.sin(bearing), distance * np.cos(bearing), rng.uniform(-0.7, 1.5, 90)], -1
    )
    shift = np.where(np.arange(90)[:, None] < 90 * moved, rng.normal(0.0, 0.3, (90, 3)), 0.0)
    c, s = math.cos(PHI), math.sin(PHI)
    from_start = (points + shift - [*AT, 0.0]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    seen = []
    for rays in (points, from_start):
        pixels, _ = CAMERA.robot_pixels(rays)
        pixels = pixels + rng.normal(0.0, 0.1, pixels.shape) + [centre, -centre]
        seen.append(CAMERA.robot_rays(pixels)[0])
    kept = np.isfinite(seen[0]).all(axis=1) & np.isfinite(seen[1]).all(axis=1)
    return seen[0][kept], seen[1][kept]


def disagreement_of(a: np.ndarray, b: np.ndarray) -> float:
    start = math.atan2(AT[0], AT[1])
    motion = refine_planar_motion(a, b, PHI, start, SIGMA)
    return disagreement(a, b, motion, np.full(len(a), SIGMA))


def excused(a: np.ndarray, b: np.ndarray) -> bool:
    return explained_by_calibration(a, b, canvas_for(CAMERA), CAMERA, 0)


@pytest.mark.parametrize("seed", range(8))
def test_noise_alone_agrees(seed: int) -> None:
    assert 0.15 < disagreement_of(*views(seed)) < 1.6


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("centre", [8.0, -15.0])
def test_a_wrong_image_centre_is_no_reason_to_doubt_the_place(seed: int, centre: float) -> None:
    pair = views(seed, centre=centre)
    assert disagreement_of(*pair) > MOST_DISAGREEMENT
    assert excused(*pair)


@pytest.mark.parametrize("seed", range(4))
def test_moved_things_are(seed: int) -> None:
    pair = views(seed, moved=0.7)
    assert disagreement_of(*pair) > MOST_DISAGREEMENT
    assert not excused(*pair)


@pytest.mark.parametrize("seed", range(4))
def test_a_wrong_image_centre_does_not_excuse_moved_things(seed: int) -> None:
    assert not excused(*views(seed, moved=0.5, centre=10.0))


def evidence(**changes: object) -> Evidence:
    a, b = views(0)
    motion = refine_planar_motion(a, b, PHI, math.atan2(AT[0], AT[1]), SIGMA)
    plain = {"distinctive": 200, "repeated": 0.1, "rivals": 2, "alias": False, "disagreement": 1.0}
    return Evidence(motion=motion, **(plain | changes))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, ""),
        ({"rivals": 40}, "another place explains 40 features"),
        ({"rivals": 10}, ""),
        ({"alias": True}, "one plane"),
        ({"disagreement": 5.0}, "5.0 times their noise"),
        ({"disagreement": 5.0, "rivals": 40, "calibration": True}, ""),
        ({"distinctive": FEWEST_DISTINCTIVE - 1, "repeated": 0.9}, "repeats itself"),
        ({"distinctive": FEWEST_DISTINCTIVE - 1, "repeated": 0.1}, ""),
    ],
)
def test_an_objection_says_what_is_wrong(changes: dict[str, object], words: str) -> None:
    objection = evidence(**changes).objection
    assert words in objection
    assert bool(objection) == bool(words)


@pytest.mark.parametrize("noise", [1.0, 3.0, 8.0])
def test_noise_is_measured_whatever_the_picture_shows(noise: float) -> None:
    rng = np.random.default_rng(1)
    smooth = cv2.GaussianBlur(rng.uniform(60, 200, (300, 400)), (0, 0), 6.0)
    smooth = 128 + 4.0 * (smooth - smooth.mean())
    image = np.clip(smooth + rng.normal(0.0, noise, smooth.shape), 0, 255).astype(np.uint8)
    assert pixel_noise(image, np.ones_like(image)) == pytest.approx(noise, rel=0.15)


def test_a_flat_patch_is_located_worse_than_a_corner() -> None:
    camera = load_camera("perspective")
    canvas = FlatCanvas(camera)
    image = np.full((camera.height, camera.width), 100, np.uint8)
    image[100:, 100:] = 200
    image = np.clip(image + np.random.default_rng(0).normal(0, 2, image.shape), 0, 255)
    points = np.array([[100.0, 100.0], [100.0, 200.0], [50.0, 50.0]])
    corner, edge, flat = position_deviations(image.astype(np.uint8), canvas, points)
    assert corner < 0.1
    assert edge > 3.0 * corner
    assert flat > 3.0 * corner


@pytest.mark.sim
def test_a_start_among_equal_pillars_is_refused_and_one_in_the_hall_is_not() -> None:
    """The short form of ``visctrl reproduce matches``."""
    among, hall = (
        matches.match_world(matches._spec(case, 400, 2))["pairs"]
        for case in (matches.Case("pillars", "ambiguous"), matches.Case("hall", "well posed"))
    )
    assert {pair["outcome"] for pair in among} <= {matches.REFUSED, matches.NEEDLESS}
    assert {pair["outcome"] for pair in hall} == {matches.ACCEPTED}
    assert all("repeats itself" in pair["reason"] for pair in among)
