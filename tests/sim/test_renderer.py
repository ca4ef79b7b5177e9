"""Rendered pictures lie where the camera model says, for every camera and renderer."""

from collections.abc import Iterator

import numpy as np
import pytest

from visctrl.hal.cameras.catalogue import camera_names, load_camera, parse_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Pose
from visctrl.reproduce.camera_models import CAMERAS
from visctrl.sim.options import RendererName
from visctrl.sim.render.accuracy import checker_room, measure_corners
from visctrl.sim.render.renderer import Renderer
from visctrl.sim.render.renderer_choice import drawer_problem, open_renderer
from visctrl.sim.world.frames import heading_matrix
from visctrl.sim.world.scene import Ground, Item, Room, Scene

pytestmark = pytest.mark.sim

POSES = [Pose(0.2, -0.3, 0.4), Pose(-0.7, 0.6, 2.2), Pose(0.8, 0.5, -1.3), Pose(-0.6, -0.8, -2.6)]
HEIGHT_M = 0.75
TILTED = load_camera("hypercatadioptric").altered(
    name="tilted mirror image", fx=-117.0, skew=2.0, pitch_deg=5.0, roll_deg=-3.0, yaw_deg=30.0
)
UPWARD = load_camera("fisheye").altered(name="upward fisheye", optical_axis="up", xi=1.6)
SCENE = Scene(
    name="small",
    seed=3,
    room=Room(x_m=(-3, 3), y_m=(-3, 3), height_m=2.5),
    items=(Item(name="box", at_m=(0.0, 1.8), size_m=(0.6, 0.4, 1.0)),),
)


HYPER = load_camera("hypercatadioptric").resized(400, 300)


@pytest.fixture(scope="module", params=["tiny", "gl"])
def drawer(request: pytest.FixtureRequest) -> RendererName:
    name: RendererName = request.param
    skip_unless_it_works(name)
    return name


def skip_unless_it_works(name: RendererName) -> None:
    if problem := drawer_problem(name):
        pytest.skip(problem)


def drawn(
    drawer: RendererName, camera: CentralCamera, pose: Pose, scene: Scene = SCENE, **options: object
) -> np.ndarray:
    view = open_renderer(drawer, scene, camera, **options)  # type: ignore[arg-type]
    try:
        return view.render(pose, HEIGHT_M)
    finally:
        view.close()


def check_corners(
    camera: CentralCamera, drawer: RendererName, poses: list[Pose], coverage: float
) -> None:
    view = open_renderer(drawer, checker_room(), camera)
    try:
        found = measure_corners(view, camera, poses)
    finally:
        view.close()
    assert len(found.errors) > 100
    assert found.percentile(0.95) <= 0.2
    # A wrong pixel convention would shift everything by half a pixel.
    assert np.abs(found.errors.mean(axis=0)).max() < 0.04
    assert found.coverage > coverage


@pytest.mark.parametrize(
    "camera",
    [*(load_camera(name) for name in camera_names()), TILTED, UPWARD],
    ids=lambda camera: camera.name,
)
def test_known_corners_lie_where_the_model_says(
    drawer: RendererName, camera: CentralCamera
) -> None:
    check_corners(camera, drawer, POSES, 0.6 if camera.rectilinear else 0.9)


@pytest.mark.parametrize("name", sorted(CAMERAS))
def test_distorted_cameras_are_drawn_as_they_are(drawer: RendererName, name: str) -> None:
    camera = parse_camera({"name": name, **CAMERAS[name][1]}, name)
    check_corners(camera, drawer, POSES[:2], 0.2)


@pytest.fixture(scope="module")
def hyper(drawer: RendererName) -> Iterator[Renderer]:
    view = open_renderer(drawer, SCENE, HYPER)
    yield view
    view.close()


def test_the_same_view_gives_the_same_bits(drawer: RendererName, hyper: Renderer) -> None:
    first = hyper.render(POSES[0], HEIGHT_M)
    other = drawn(drawer, HYPER, POSES[0])
    assert first.dtype == np.uint8
    assert first.shape == (300, 400)
    assert np.array_equal(first, other)


def test_outside_the_mirror_it_is_black_and_inside_it_is_not(hyper: Renderer) -> None:
    image = hyper.render(POSES[0], HEIGHT_M)
    v, u = np.mgrid[0:300, 0:400]
    _, valid = HYPER.unproject(np.stack([u, v], axis=-1).astype(float))
    assert (image[~valid] == 0).all()
    assert image[valid].min() > 0
    assert image[valid].std() > 15


def test_turning_the_robot_turns_a_mirrors_image(hyper: Renderer) -> None:
    straight = hyper.render(Pose(0.1, 0.2, 0.0), HEIGHT_M).astype(float)
    turned = hyper.render(Pose(0.1, 0.2, np.pi), HEIGHT_M).astype(float)
    half_turn = turned[::-1, ::-1]
    inside = straight > 0
    assert np.corrcoef(straight[inside], half_turn[inside])[0, 1] > 0.95
    assert np.corrcoef(straight[inside], turned[inside])[0, 1] < 0.6


@pytest.mark.parametrize("up", [False, True], ids=["floor", "ceiling"])
def test_floor_and_ceiling_move_as_planes_do(drawer: RendererName, up: bool) -> None:
    """Points of the plane look alike from two poses, and unlike if the plane is misplaced."""
    room = SCENE.room.model_copy(
        update={
            "floor": Ground(shade=0.5, contrast=0.3),
            "ceiling": Ground(shade=0.5, contrast=0.3),
        }
    )
    scene = SCENE.model_copy(update={"room": room, "items": ()})
    camera = load_camera("paracatadioptric").resized(400, 300)
    a, b = Pose(0.0, 0.0, 0.0), Pose(0.3, -0.2, 0.8)
    plane = room.height_m if up else 0.0
    rng = np.random.default_rng(2)
    # The mirror shows the ceiling from far only, the floor from near.
    points = rng.uniform(-2.9, 2.9, (6000, 2)) if up else rng.uniform(-1.8, 1.8, (6000, 2))
    images = {pose: drawn(drawer, camera, pose, scene) for pose in (a, b)}

    def look(pose: Pose, height: float) -> tuple[np.ndarray, np.ndarray]:
        world = np.column_stack([points, np.full(len(points), height)])
        rays = (world - [pose.x, pose.y, HEIGHT_M]) @ heading_matrix(pose.phi)
        pixels, seen = camera.robot_pixels(rays)
        where = np.rint(np.nan_to_num(pixels)).astype(int)
        where = np.clip(where, 0, [camera.width - 1, camera.height - 1])
        return images[pose][where[:, 1], where[:, 0]].astype(float), seen

    def likeness(height: float) -> float:
        (seen_a, ok_a), (seen_b, ok_b) = look(a, height), look(b, height)
        both = ok_a & ok_b
        assert both.sum() > 300
        return float(np.corrcoef(seen_a[both], seen_b[both])[0, 1])

    assert likeness(plane) > 0.85
    misplaced = plane - (0.4 if up else 0.15)
    assert likeness(misplaced) < likeness(plane) - 0.1


def test_without_its_texture_the_floor_is_one_shade(drawer: RendererName) -> None:
    camera = load_camera("paracatadioptric").resized(400, 300)
    image = drawn(drawer, camera, Pose(0, 0, 0), floor=False)
    near = np.array([[0.9, 0.0, -0.75], [-0.9, 0.1, -0.75], [0.1, -1.0, -0.75]])
    pixels, _ = camera.robot_pixels(near)
    shades = image[tuple(np.rint(pixels[:, ::-1]).astype(int).T)]
    assert np.ptp(shades) == 0


def test_a_moved_item_is_seen_where_it_is(drawer: RendererName, hyper: Renderer) -> None:
    pose = Pose(0.0, 0.0, 0.0)
    before = hyper.render(pose, HEIGHT_M)
    hyper.place("box", Pose(1.9, -0.5, 0.7))
    after = hyper.render(pose, HEIGHT_M)
    hyper.place("box", Pose(0.0, 1.8, 0.0))
    assert np.array_equal(hyper.render(pose, HEIGHT_M), before)
    # The same as a scene that has it there from the beginning.
    item = SCENE.items[0].model_copy(update={"at_m": (1.9, -0.5), "yaw_deg": np.degrees(0.7)})
    there = drawn(drawer, HYPER, pose, SCENE.model_copy(update={"items": (item,)}))
    assert np.mean(np.abs(after.astype(float) - there) > 8) < 0.003
    assert np.mean(np.abs(after.astype(float) - before) > 8) > 0.01


def test_a_finer_or_coarser_layout_shows_the_same(drawer: RendererName, hyper: Renderer) -> None:
    image = hyper.render(POSES[0], HEIGHT_M).astype(float)
    for detail in (0.7, 1.5):
        other = drawn(drawer, HYPER, POSES[0], detail=detail).astype(float)
        inside = image > 0
        assert np.corrcoef(image[inside], other[inside])[0, 1] > 0.95


def test_closing_twice_is_harmless(drawer: RendererName) -> None:
    view = open_renderer(drawer, SCENE, load_camera("perspective").resized(160, 120))
    view.close()
    view.close()
