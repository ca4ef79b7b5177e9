from __future__ import annotations

import numpy as np
import pytest
from driving import START, room

from visctrl.perception.matching import describe
from visctrl.perception.pictures import draw
from visctrl.perception.tracker import follow, returns, shift
from visctrl.perception.unwrap import SEAM_PADDING_PX, canvas_for

NAME, WIDTH = "hypercatadioptric", 400


@pytest.fixture(scope="module")
def canvas():
    return canvas_for(room(NAME, WIDTH).camera)


def seen(canvas, pose):
    return draw(room(NAME, WIDTH).frame(pose, 1, noise=2.0).image, canvas)


@pytest.mark.parametrize("turn_deg", [0.0, 4.0, -15.0])
def test_a_turn_is_followed_however_fast(canvas, turn_deg):
    before = seen(canvas, START)
    after = seen(canvas, START._replace(phi=START.phi + np.radians(turn_deg)))
    columns = canvas.scale * np.radians(turn_deg)
    assert shift(before, after, canvas) == pytest.approx(columns, abs=1.0)
    points = describe(before.image, canvas, 150, 12).points
    moved, found = follow(before, after, points, canvas)
    expected = canvas.canonical(points + np.array([columns, 0.0]))
    error = np.linalg.norm(moved - expected, axis=1)
    assert found.mean() > 0.95
    assert np.median(error) < 0.1
    assert np.mean(error < 0.5) > 0.9
    kept = returns(after, before, moved, points, canvas, 0.5)
    assert kept.mean() > 0.85
    assert np.all(error[kept] < 1.0)


def test_points_cross_the_seam(canvas):
    turn = np.radians(6.0)
    before = seen(canvas, START)
    after = seen(canvas, START._replace(phi=START.phi + turn))
    points = describe(before.image, canvas, 300, 12).points
    crossing = points[:, 0] > canvas.shape[1] - SEAM_PADDING_PX - canvas.scale * turn
    assert crossing.sum() >= 3
    moved, found = follow(before, after, points[crossing], canvas)
    good = found & returns(after, before, moved, points[crossing], canvas, 0.5)
    assert good.any()
    assert np.all(moved[good][:, 0] < SEAM_PADDING_PX + canvas.scale * turn)


def test_pictures_that_have_nothing_in_common_do_not_pull_the_search_away(canvas):
    rng = np.random.default_rng(0)
    camera = room(NAME, WIDTH).camera
    one, other = (
        draw(rng.integers(0, 255, (camera.height, camera.width)).astype(np.uint8), canvas)
        for _ in range(2)
    )
    assert shift(one, other, canvas) == 0.0


def test_what_has_changed_does_not_track_back(canvas):
    before = seen(canvas, START)
    after = seen(canvas, START._replace(phi=START.phi + np.pi / 2))
    points = describe(before.image, canvas, 150, 12).points
    moved, _ = follow(before, before, points, canvas)
    assert np.linalg.norm(moved - points, axis=1).max() < 0.05
    assert np.mean(returns(after, before, moved, points, canvas, 0.5)) < 0.2


def test_no_points_are_no_trouble(canvas):
    picture = seen(canvas, START)
    moved, found = follow(picture, picture, np.zeros((0, 2)), canvas)
    assert moved.shape == (0, 2)
    assert found.shape == (0,)
