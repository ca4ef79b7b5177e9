from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from visctrl.hal.cameras.catalogue import camera_names, load_camera
from visctrl.perception.unwrap import SEAM_PADDING_PX, Cylinder, FlatCanvas, canvas_for

CYLINDERS = [name for name in camera_names() if name != "perspective"]


def painted(camera, phi=0.0):
    """Return the image of a smooth pattern on the horizon's cylinder, the robot turned by φ."""
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    rays, seen = camera.robot_rays(grid.astype(float))
    grey = pattern(np.where(seen[..., None], rays, 1.0), phi)
    return np.where(seen, np.rint(grey), 0).astype(np.uint8)


def pattern(rays, phi=0.0):
    bearing = np.arctan2(rays[..., 0], rays[..., 1]) - phi
    tangent = rays[..., 2] / np.hypot(rays[..., 0], rays[..., 1])
    return 128 + 60 * np.cos(7 * bearing) + 50 * np.sin(9 * tangent + 3 * bearing)


@pytest.mark.parametrize("name", camera_names())
def test_points_and_rays_are_inverse_over_the_whole_canvas(name):
    canvas = canvas_for(load_camera(name))
    row, column = np.nonzero(canvas.mask)
    points = np.stack([column, row], axis=-1)[::97].astype(float)
    rays = canvas.rays(points)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose(canvas.points(rays), points, atol=1e-8)


@given(st.sampled_from(CYLINDERS), st.floats(-np.pi, np.pi), st.floats(-0.6, 0.4))
def test_a_column_is_a_bearing_and_a_row_an_elevation(name, bearing, tangent):
    canvas = cylinder(name)
    point = canvas.points([np.sin(bearing), np.cos(bearing), tangent])
    ray = canvas.rays(point)
    assert np.cos(np.arctan2(ray[0], ray[1]) - bearing) == pytest.approx(1.0, abs=1e-12)
    assert ray[2] / np.hypot(ray[0], ray[1]) == pytest.approx(tangent, abs=1e-12)
    step = canvas.rays(point + np.array([1.0, 0.0]))
    turn = np.arctan2(step[0], step[1]) - bearing
    assert np.cos(turn) == pytest.approx(np.cos(1 / canvas.scale), abs=1e-12)


_made: dict[str, Cylinder] = {}


def cylinder(name):
    if name not in _made:
        canvas = canvas_for(load_camera(name))
        assert isinstance(canvas, Cylinder)
        _made[name] = canvas
    return _made[name]


@pytest.mark.parametrize("name", CYLINDERS)
def test_the_camera_image_lands_at_its_rays(name):
    camera, canvas = load_camera(name), cylinder(name)
    drawn = canvas.warp(painted(camera)).astype(float)
    row, column = np.mgrid[0 : canvas.shape[0], 0 : canvas.shape[1]]
    expected = pattern(canvas.rays(np.stack([column, row], axis=-1)))
    inner = canvas.mask.copy()
    # One pixel in from the edge, bilinear weights no longer reach outside the field of view.
    rows, columns = np.nonzero(inner == 0)
    for dr in range(-3, 4):
        for dc in range(-3, 4):
            r = np.clip(rows + dr, 0, canvas.shape[0] - 1)
            inner[r, np.clip(columns + dc, 0, canvas.shape[1] - 1)] = 0
    error = np.abs(drawn - expected)[inner > 0]
    assert inner.any()
    assert np.percentile(error, 99) < 2.0


def test_a_turn_of_the_robot_shifts_the_canvas():
    camera, canvas = load_camera("hypercatadioptric"), cylinder("hypercatadioptric")
    pixels = 40
    before = canvas.warp(painted(camera)).astype(float)
    after = canvas.warp(painted(camera, pixels / canvas.scale)).astype(float)
    middle = slice(SEAM_PADDING_PX + pixels, -SEAM_PADDING_PX - pixels)
    rows = slice(10, -10)
    shifted = np.roll(before, pixels, axis=1)
    assert np.abs(after - shifted)[rows, middle].max() < 4.0


@pytest.mark.parametrize("name", ["hypercatadioptric", "paracatadioptric"])
def test_the_seam_repeats_the_other_side_and_is_nowhere_twice_in_the_mask(name):
    camera, canvas = load_camera(name), cylinder(name)
    drawn = canvas.warp(painted(camera))
    period = canvas.shape[1] - 2 * SEAM_PADDING_PX
    left = drawn[:, : 2 * SEAM_PADDING_PX].astype(int)
    again = drawn[:, period : period + 2 * SEAM_PADDING_PX].astype(int)
    assert np.abs(left - again).max() <= 1
    assert np.count_nonzero(canvas.mask.any(axis=0)) == period
    point = np.array([[SEAM_PADDING_PX - 20.0, 100.0]])
    assert canvas.canonical(point)[0, 0] == pytest.approx(point[0, 0] + period)
    np.testing.assert_allclose(canvas.rays(point), canvas.rays(canvas.canonical(point)), atol=1e-12)


def test_a_perspective_image_is_its_own_canvas():
    camera = load_camera("perspective")
    canvas = canvas_for(camera)
    assert isinstance(canvas, FlatCanvas)
    image = painted(camera)
    assert canvas.warp(image) is image
    assert canvas.points([[0.0, -1.0, 0.0]]).shape == (1, 2)
    assert not canvas.inside(canvas.points([[0.0, -1.0, 0.0]]))[0]


def test_the_wanted_scale_is_kept_up_to_a_whole_turn():
    canvas = canvas_for(load_camera("hypercatadioptric"), 100.0)
    assert canvas.scale == pytest.approx(100.0, rel=1e-3)
    assert (canvas.shape[1] - 2 * SEAM_PADDING_PX) / canvas.scale == pytest.approx(2 * np.pi)


def test_inside_keeps_off_the_edges_and_copes_with_nonsense():
    canvas = cylinder("hypercatadioptric")
    rows, columns = canvas.shape
    points = [[columns / 2, rows / 2], [3.0, rows / 2], [np.nan, 5.0], [1e9, 5.0], [-4.0, 5.0]]
    assert canvas.inside(points, margin=10).tolist() == [True, False, False, False, False]
