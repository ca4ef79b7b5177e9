"""One mipmapped sheet holds every texture whole, apart from the others, at every level."""

import numpy as np
import pytest

from visctrl.hal.types import Pose
from visctrl.sim.render.ground import PERIOD_M, plane_levels
from visctrl.sim.render.surfaces import surfaces
from visctrl.sim.render.texture_sheet import Picture, TextureSheet, pack, shown
from visctrl.sim.render.textures import BASE_DENSITY, LEVELS, Levels
from visctrl.sim.world.scene import Ground, Item, Room, Scene

BLOCK = 2 ** (LEVELS - 1)
SCENE = Scene(
    name="small",
    seed=3,
    room=Room(x_m=(-3, 3), y_m=(-3, 17), height_m=2.5, floor=Ground(shade=0.4, contrast=0.2)),
    items=(Item(name="box", at_m=(0.0, 1.8), size_m=(0.6, 0.4, 1.0)),),
)


def picture(width: int, height: int, seed: int, periodic: bool = False) -> Picture:
    rng = np.random.default_rng(seed)
    levels = [
        rng.integers(1, 255, (height >> k, width >> k), dtype=np.uint8) for k in range(LEVELS)
    ]
    return Picture(levels, periodic)


def region(sheet: TextureSheet, k: int, level: int, rim: int = 0) -> np.ndarray:
    place = sheet.places[k]
    row, column = place.row >> level, place.column >> level
    height, width = place.height >> level, place.width >> level
    return sheet.levels[level][row - rim : row + height + rim, column - rim : column + width + rim]


@pytest.mark.parametrize("periodic", [False, True])
def test_every_picture_lies_in_every_level_with_a_rim(periodic: bool) -> None:
    rng = np.random.default_rng(1)
    sizes = BLOCK * rng.integers(1, 12, (40, 2))
    pictures = [
        picture(width, height, k, periodic) for k, (width, height) in enumerate(sizes.tolist())
    ]
    sheet = pack(pictures)
    for k, each in enumerate(pictures):
        for level, image in enumerate(each.levels):
            assert np.array_equal(region(sheet, k, level), image)
            rim = np.pad(image, 1, mode="wrap" if periodic else "edge")
            assert np.array_equal(region(sheet, k, level, rim=1), rim)
    assert [level.shape for level in sheet.levels] == [
        tuple(side >> k for side in sheet.levels[0].shape) for k in range(LEVELS)
    ]


def test_the_sheet_is_not_much_larger_than_its_pictures() -> None:
    sheet = shown(SCENE, planes=True).sheet
    whole = sum((p.width + 2 * BLOCK) * (p.height + 2 * BLOCK) for p in set(sheet.places))
    assert sheet.levels[0].size < 1.5 * whole


def test_a_picture_shown_twice_is_stored_once() -> None:
    one, other = picture(BLOCK, BLOCK, 1), picture(BLOCK, BLOCK, 2)
    places = pack([one, other, one]).places
    assert places[0] == places[2] != places[1]


def test_a_scene_is_its_surfaces_and_whole_periods_of_floor_and_ceiling() -> None:
    world = shown(SCENE, planes=True)
    drawn = surfaces(SCENE)
    assert len(world.rectangles) == len(world.items) == len(world.sheet.places)
    assert world.items[:6] == ("box",) * 5 + ("",)
    # x from -16 to 16 m, y from -16 to 32 m, below and above.
    planes = world.rectangles[len(drawn) :]
    assert len(planes) == 2 * 2 * 3
    corners = np.concatenate([side.corners for side in planes])
    assert corners.min(axis=0).tolist() == [-16.0, -16.0, 0.0]
    assert corners.max(axis=0).tolist() == [16.0, 32.0, 2.5]
    # All look into the room.
    assert {(side.corner[2], side.normal[2]) for side in planes} == {(0.0, 1.0), (2.5, -1.0)}


def test_levels_are_the_patterns_own_at_half_the_resolution_each() -> None:
    world = shown(SCENE, planes=True)
    surface = surfaces(SCENE)[0]
    place = world.sheet.places[0]
    assert place.width >= surface.pattern.width_m * BASE_DENSITY
    own = Levels(surface.pattern)
    for level in (1, 3):
        image = region(world.sheet, 0, level).astype(float)
        plane = own.plane(level).astype(float)
        across = (np.arange(image.shape[1]) + 0.5) / image.shape[1] * plane.shape[1]
        down = (np.arange(image.shape[0]) + 0.5) / image.shape[0] * plane.shape[0]
        near = plane[down.astype(int)[:, None], across.astype(int)]
        assert np.corrcoef(image.ravel(), near.ravel())[0, 1] > 0.97


@pytest.mark.parametrize("ceiling", [False, True])
def test_floor_and_ceiling_lie_as_their_texture_says(ceiling: bool) -> None:
    """Columns run along x and rows along y, from the origin, from wherever one looks."""
    world = shown(SCENE, planes=True)
    paint = SCENE.room.ceiling if ceiling else SCENE.room.floor
    texture = next(plane_levels(paint, SCENE.seed, int(ceiling)))
    first = len(surfaces(SCENE)) + (6 if ceiling else 0)
    for k in (first, first + 4):
        side, image = world.rectangles[k], region(world.sheet, k, 0)
        for at in (Pose(1.3, 2.2, 0.0), Pose(15.1, 9.7, 0.0), Pose(6.0, 0.4, 0.0)):
            # The same place a whole number of periods on.
            point = np.array([at.x, at.y, side.corner[2]])
            point[:2] += PERIOD_M * np.floor(side.corners.min(axis=0)[:2] / PERIOD_M + 0.5)
            a = (point - side.corner) @ side.right / (side.right @ side.right)
            b = (point - side.corner) @ side.up / (side.up @ side.up)
            size = len(image)
            seen = image[int((1.0 - b) * size), int(a * size)]
            meant = texture[int(at.y / PERIOD_M * size), int(at.x / PERIOD_M * size)]
            assert abs(float(seen) - float(meant)) < 6.0


def test_without_planes_they_are_one_shade() -> None:
    world = shown(SCENE, planes=False)
    floor = len(surfaces(SCENE))
    assert set(region(world.sheet, floor, 0).ravel().tolist()) == {round(255 * 0.4)}
