from __future__ import annotations

import cv2
import numpy as np
import pytest
from box_room import texture

from visctrl.hal.cameras.catalogue import camera_names, load_camera
from visctrl.perception.patch_alignment import HALF, Patches, Source
from visctrl.perception.unwrap import canvas_for


def plain(image):
    """Return a source whose points are its pixels."""
    return Source(image, lambda columns, rows: (columns, rows))


def picture():
    return np.rint(texture(3)[2][:400, :500]).astype(np.uint8)


def warped(image, matrix, offset, centre):
    """Return the image in which `centre + d` of the given one appears at M d + centre + offset."""
    M = np.asarray(matrix, float)
    translation = np.asarray(centre) + offset - M @ centre
    affine = np.concatenate([M, translation[:, None]], axis=1)
    size = (image.shape[1], image.shape[0])
    return cv2.warpAffine(image, affine, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def centres():
    rng = np.random.default_rng(5)
    return rng.uniform([150, 120], [350, 280], (40, 2))


@pytest.mark.parametrize(
    "matrix",
    [np.eye(2), np.eye(2) * 0.8, np.eye(2) * 1.25, [[1.1, 0.15], [-0.1, 0.95]]],
    ids=["same", "farther", "nearer", "slanted"],
)
def test_affine_warps_are_found_to_a_twentieth_of_a_pixel(matrix):
    image, middle = picture(), np.array([250.0, 200.0])
    offset = np.array([1.3, -0.7])
    other = warped(image, matrix, offset, middle)
    points = centres()
    truth = (points - middle) @ np.asarray(matrix).T + middle + offset
    start = truth + np.random.default_rng(1).uniform(-1.2, 1.2, points.shape)
    found = Patches((plain(image), points)).align(
        plain(other), np.arange(len(points)), start, np.tile(np.eye(2), (len(points), 1, 1)), 20
    )
    error = np.linalg.norm(found.points - truth, axis=1)
    good = found.score > 0.8
    assert good.mean() > 0.9
    assert np.median(error[good]) < 0.05
    assert np.percentile(error[good], 95) < 0.2
    np.testing.assert_allclose(np.median(found.warps[good], axis=0), matrix, atol=0.03)


def test_gain_and_offset_make_no_difference():
    image = picture()
    points = centres()
    dim = np.clip(0.6 * image.astype(float) + 20, 0, 255).astype(np.uint8)
    start = points + np.array([0.8, -0.6])
    warps = np.tile(np.eye(2), (len(points), 1, 1))
    found = Patches((plain(image), points)).align(
        plain(dim), np.arange(len(points)), start, warps, 12
    )
    assert np.abs(found.points - points).max() < 0.05
    assert found.score.min() > 0.98


def test_something_else_does_not_score():
    points = centres()
    other = np.rint(texture(4)[2][:400, :500]).astype(np.uint8)
    warps = np.tile(np.eye(2), (len(points), 1, 1))
    found = Patches((plain(picture()), points)).align(
        plain(other), np.arange(len(points)), points, warps, 10
    )
    assert np.mean(found.score > 0.8) < 0.1


@pytest.mark.parametrize("name", camera_names())
def test_patches_are_taken_from_where_the_camera_model_puts_their_pixels(name):
    camera = load_camera(name)
    canvas = canvas_for(camera)
    rng = np.random.default_rng(2)
    inner = cv2.erode(canvas.mask, np.ones((45, 45), np.uint8), borderValue=0)
    rows, columns = np.nonzero(inner)
    chosen = rng.choice(len(rows), 300, replace=False)
    points = np.stack([columns, rows], axis=-1)[chosen] + rng.uniform(-0.5, 0.5, (300, 2))
    warps = np.eye(2) * rng.uniform(0.5, 1.6, (300, 1, 1)) + rng.uniform(-0.2, 0.2, (300, 2, 2))
    side = np.arange(-HALF, HALF + 1.0)
    offsets = np.stack([d.ravel() for d in np.meshgrid(side, side)])
    pixels = points[:, None] + (warps @ offsets).transpose(0, 2, 1)
    expected, _ = camera.robot_pixels(canvas.rays(pixels))
    # Images whose grey level is the column, or the row, say where they were looked at.
    for k, image in enumerate(np.indices((camera.height, camera.width), np.float32)[::-1]):
        seen = Source(image, canvas.pixels).sample(points, warps)
        assert np.abs(seen - expected[..., k]).max() < 0.03


def test_a_subset_is_aligned_like_the_whole_and_none_at_all_is_fine():
    image, points = picture(), centres()
    patches = Patches((plain(image), points))
    warps = np.tile(np.eye(2), (len(points), 1, 1))
    seen = plain(warped(image, np.eye(2), np.array([0.5, 0.25]), np.zeros(2)))
    whole = patches.align(seen, np.arange(len(points)), points, warps, 4)
    some = np.array([7, 2, 30])
    part = patches.align(seen, some, points[some], warps[some], 4)
    np.testing.assert_allclose(part.points, whole.points[some], atol=1e-4)
    np.testing.assert_allclose(part.score, whole.score[some], atol=1e-4)
    none = patches.align(seen, np.zeros(0, dtype=np.intp), points[:0], warps[:0], 4)
    assert none.points.shape == (0, 2)


def test_a_flat_patch_neither_divides_by_zero_nor_scores():
    flat = np.full((60, 60), 90, dtype=np.uint8)
    patches = Patches((plain(flat), np.array([[30.0, 30.0]])))
    found = patches.align(
        plain(picture()[:60, :60]), np.array([0]), np.array([[30.0, 30.0]]), np.eye(2)[None], 4
    )
    assert np.isfinite(found.points).all()
    assert found.score[0] < 0.8
