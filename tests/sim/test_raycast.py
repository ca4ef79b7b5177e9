"""What each tile may show holds all that its rays meet, by intersections worked out otherwise."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from visctrl.hal.cameras.catalogue import camera_names, load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Pose
from visctrl.sim.render.raycast import Candidates, RectangleSet, Seen, Tiles, cut_tiles
from visctrl.sim.render.surfaces import Rectangle
from visctrl.sim.render.texture_sheet import shown
from visctrl.sim.world.frames import displacement, heading_matrix
from visctrl.sim.world.scene import load_scene

Array = NDArray[np.float64]

SIDE = 4
CAMERAS = [load_camera(name).resized(160, 120) for name in camera_names()]
cameras = pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)
HALL = shown(load_scene("hall"), planes=False).rectangles
EYES = [Pose(-0.55, -1.35, -0.6), Pose(1.1, -3.0, 2.0), Pose(0.0, 0.0, 0.0)]


def rays_of(camera: CentralCamera) -> tuple[Array, NDArray[np.bool_]]:
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(float)
    return camera.unproject(np.stack([u, v], axis=-1))


def distances(rectangles: list[Rectangle], eye: Array, rays: Array) -> Array:
    """Return how far away (N, rectangles) world rays (N, 3) meet the fronts; infinite if not."""
    found = np.full((len(rays), len(rectangles)), np.inf)
    for k, side in enumerate(rectangles):
        against = rays @ side.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (side.corner - eye) @ side.normal / against
            at = eye + t[:, None] * rays - side.corner
        a = at @ side.right / (side.right @ side.right)
        b = at @ side.up / (side.up @ side.up)
        met = (against < 0) & (t > 0) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
        found[met, k] = t[met]
    return found


def cut(camera: CentralCamera) -> tuple[Tiles, Array, NDArray[np.bool_]]:
    rays, valid = rays_of(camera)
    return cut_tiles(rays, valid, SIDE), rays, valid


def lists(found: Candidates, seen: Seen) -> list[set[int]]:
    ends = np.cumsum(found.counts)
    return [
        set(seen.numbers[found.which[end - count : end]].tolist())
        for count, end in zip(found.counts, ends, strict=True)
    ]


@cameras
def test_tiles_hold_every_valid_pixel_once_and_its_ray_within_reach(camera: CentralCamera) -> None:
    tiles, rays, valid = cut(camera)
    gathered = tiles.gather(np.where(valid[..., None], rays, 0.0))
    assert gathered.shape == (len(tiles.axis), SIDE, SIDE, 3)
    covered = np.zeros(valid.shape, dtype=int)
    for k, ((column, row), axis, reach) in enumerate(
        zip(tiles.corner, tiles.axis, tiles.reach, strict=True)
    ):
        here = np.s_[row : row + SIDE, column : column + SIDE]
        covered[here] += 1
        rows, columns = covered[here].shape
        shown_here = np.where(valid[here][..., None], rays[here], 0.0)
        assert np.array_equal(gathered[k, :rows, :columns], shown_here)
        mine = rays[here][valid[here]]
        assert len(mine)
        assert np.linalg.norm(mine - axis, axis=-1).max() <= reach + 1e-6
    assert covered.max() == 1
    assert covered[valid].all()


@cameras
@pytest.mark.parametrize("pose", EYES, ids=str)
def test_what_a_tiles_rays_meet_first_is_among_its_candidates(
    camera: CentralCamera, pose: Pose
) -> None:
    tiles, rays, valid = cut(camera)
    eye = np.array([pose.x, pose.y, 0.75])
    axes = heading_matrix(pose.phi) @ camera.rotation
    seen = RectangleSet(HALL).seen_from(eye, axes)
    found = tiles.candidates(seen)
    listed = lists(found, seen)
    nearest = np.full(valid.shape, -1)
    nearest[valid] = np.argmin(distances(list(HALL), eye, rays[valid] @ axes.T), axis=1)
    missing = lonely = 0
    for k, (column, row) in enumerate(tiles.corner):
        here = np.s_[row : row + SIDE, column : column + SIDE]
        first = set(nearest[here][valid[here]].tolist())
        missing += not first <= listed[k]
        if found.filled[k] and found.counts[k] == 1:
            lonely += 1
            assert first == listed[k]
    assert missing == 0
    # The lists are of use: a good part of the tiles shows one thing, few show many.
    assert lonely > 0.4 * len(tiles.axis)
    assert found.counts.mean() < 3.0


def test_maps_tell_place_and_distance() -> None:
    rng = np.random.default_rng(4)
    camera = CAMERAS[0]
    eye = np.array([0.3, -1.0, 0.7])
    axes = heading_matrix(0.4) @ camera.rotation
    seen = RectangleSet(HALL).seen_from(eye, axes)
    for number, M, distance in zip(*seen, strict=True):
        side = HALL[number]
        a, b = rng.uniform(0.0, 1.0, 2)
        point = side.corner + a * side.right + (1.0 - b) * side.up
        away = np.linalg.norm(point - eye)
        w, p, q = M @ axes.T @ ((point - eye) / away)
        assert 1.0 / w == pytest.approx(away)
        assert (p / w, q / w) == pytest.approx((a, b), abs=1e-9)
        assert distance == pytest.approx((eye - side.corner) @ side.normal)


def test_only_fronts_are_seen() -> None:
    square = Rectangle(np.array([0.0, 2.0, 0.0]), np.array([1.0, 0, 0]), np.array([0, 0, 1.0]))
    both = RectangleSet([square, Rectangle(square.corner + square.right, -square.right, square.up)])
    assert both.seen_from(np.array([0.0, 0.0, 1.0]), np.eye(3)).numbers.tolist() == [0]
    assert both.seen_from(np.array([0.0, 4.0, 1.0]), np.eye(3)).numbers.tolist() == [1]
    assert len(both.seen_from(np.array([9.0, 2.0, 1.0]), np.eye(3)).numbers) == 0


def test_moving_there_and_back() -> None:
    rectangles = RectangleSet(HALL)
    eye, axes = np.array([0.0, 0.0, 0.7]), np.eye(3)
    before = rectangles.seen_from(eye, axes)
    which = np.arange(5)
    home, there = Pose(-0.75, 2.3, math.radians(18)), Pose(1.0, 1.0, 0.3)
    rectangles.move(which, *displacement(home, there))
    R, shift = displacement(home, there)
    moved = [
        Rectangle(R @ s.corner + shift, R @ s.right, R @ s.up) if k < 5 else s
        for k, s in enumerate(HALL)
    ]
    for ours, theirs in zip(
        rectangles.seen_from(eye, axes), RectangleSet(moved).seen_from(eye, axes), strict=True
    ):
        assert np.allclose(ours, theirs)
    rectangles.move(which, *displacement(home, home))
    for ours, theirs in zip(rectangles.seen_from(eye, axes), before, strict=True):
        assert np.array_equal(ours, theirs)


def test_from_outside_there_may_be_nothing_to_see() -> None:
    tiles, _, _ = cut(CAMERAS[0])
    nothing = RectangleSet(HALL[:1]).seen_from(np.array([0.0, 90.0, 1.0]), np.eye(3))
    found = tiles.candidates(nothing)
    assert not found.counts.any()
    assert not found.filled.any()
