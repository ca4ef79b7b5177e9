from __future__ import annotations

import numpy as np
import pytest
from driving import START, TARGET, room, target_frame

from visctrl.perception.landmarks import find_landmarks, recognise
from visctrl.perception.matching import describe, mutual_matches, planar_inliers
from visctrl.perception.pictures import draw
from visctrl.perception.unwrap import canvas_for

NAME, WIDTH, MARGIN = "hypercatadioptric", 400, 10


@pytest.fixture(scope="module")
def canvas():
    return canvas_for(room(NAME, WIDTH).camera)


@pytest.fixture(scope="module")
def target(canvas):
    picture = draw(target_frame(NAME, WIDTH).image, canvas)
    return picture, describe(picture.image, canvas, 1500, MARGIN)


@pytest.fixture(scope="module")
def initial(canvas):
    picture = draw(room(NAME, WIDTH).frame(START, 1, noise=2.0).image, canvas)
    return picture, describe(picture.image, canvas, 1500, MARGIN)


def errors_deg(rays, truth):
    return np.degrees(np.arccos(np.clip((rays * truth).sum(axis=1), -1, 1)))


def test_keypoints_are_in_the_field_of_view_spread_and_upright_once(canvas, target):
    _, described = target
    assert 500 < len(described) <= 1500
    assert canvas.inside(described.points, MARGIN - 1).all()
    assert len(
        {(*p, s) for p, s in zip(described.points.tolist(), described.sizes, strict=True)}
    ) == len(described)
    bearing = np.arctan2(described.rays[:, 0], described.rays[:, 1])
    counts, _ = np.histogram(bearing, bins=12, range=(-np.pi, np.pi))
    assert counts.min() > 0.4 * counts.mean()


def test_the_same_image_gives_the_same_keypoints(canvas, target):
    picture, described = target
    again = describe(picture.image, canvas, 1500, MARGIN)
    np.testing.assert_array_equal(again.points, described.points)
    np.testing.assert_array_equal(again.descriptors, described.descriptors)


def test_planar_motion_keeps_what_is_right(canvas, target, initial):
    (_, a), (_, b) = target, initial
    first, second = mutual_matches(a, b)
    motion = planar_inliers(a.rays[first], b.rays[second], canvas, 0)
    truth, _ = room(NAME, WIDTH).true_rays(a.rays[first], START)
    error = errors_deg(b.rays[second], truth)
    wrong = error > 3.0
    assert motion.inliers.sum() > 60
    assert np.mean(wrong[motion.inliers]) < 0.03
    assert motion.inliers[~wrong].mean() > 0.9
    assert motion.phi == pytest.approx(START.phi, abs=np.radians(0.5))
    assert motion.direction == pytest.approx(np.arctan2(START.x, START.y), abs=np.radians(1.0))


def test_landmarks_mean_the_same_point_in_both_views(canvas, target, initial):
    shared = find_landmarks(target, initial, canvas, room(NAME, WIDTH).camera, 20, 0)
    landmarks = shared.landmarks
    assert landmarks is not None
    assert shared.inliers == len(landmarks) <= shared.candidates
    truth, _ = room(NAME, WIDTH).true_rays(landmarks.target.rays, START)
    error = errors_deg(landmarks.initial.rays, truth)
    assert np.median(error) < 0.08
    assert np.percentile(error, 95) < 0.4
    unaligned = find_landmarks(
        target, initial, canvas, room(NAME, WIDTH).camera, len(landmarks) + 1, 0
    )
    assert unaligned.landmarks is None


def test_landmarks_are_recognised_from_somewhere_in_between(canvas, target, initial):
    landmarks = find_landmarks(target, initial, canvas, room(NAME, WIDTH).camera, 20, 0).landmarks
    assert landmarks is not None
    pose = TARGET._replace(x=-0.1, y=-0.5, phi=np.radians(30))
    picture = draw(room(NAME, WIDTH).frame(pose, 5, noise=2.0).image, canvas)
    described = describe(picture.image, canvas, 1500, MARGIN)
    found = recognise(described, landmarks, canvas, 0.5 / canvas.scale, 0)
    assert found is not None
    assert len(found.which) > 0.5 * len(landmarks)
    truth, _ = room(NAME, WIDTH).true_rays(landmarks.target.rays[found.which], pose)
    error = errors_deg(canvas.rays(found.points), truth)
    assert np.mean(error > 3.0) < 0.03
    baseline = np.hypot(START.x, START.y)
    np.testing.assert_allclose(found.fit.pose[:2] * baseline, pose[:2], atol=0.02)
    nothing = recognise(described.subset(np.arange(1)), landmarks, canvas, 0.01, 0)
    assert nothing is None
