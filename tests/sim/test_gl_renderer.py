"""The ray casting renderer: the same world as the rasterisers', whole, and none's business else."""

import multiprocessing
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

from visctrl.hal.cameras.catalogue import camera_names, load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.errors import InputError
from visctrl.hal.types import Pose
from visctrl.sim.render import gl_context
from visctrl.sim.render.gl_renderer import GlRenderer
from visctrl.sim.render.renderer import BulletRenderer
from visctrl.sim.render.renderer_choice import choose_drawer, drawer_problem
from visctrl.sim.world.scene import load_scene

pytestmark = [
    pytest.mark.sim,
    pytest.mark.skipif(bool(drawer_problem("gl")), reason=drawer_problem("gl")),
]

HEIGHT_M = 0.75
ROOM = load_scene(str(Path(__file__).with_name("small_room.yaml")))
POSES = [Pose(-0.55, -1.35, -0.6), Pose(0.9, -1.2, 2.9), Pose(0.0, 0.0, 0.0)]
TILTED = load_camera("hypercatadioptric").altered(
    name="tilted mirror image", fx=-117.0, skew=2.0, pitch_deg=5.0, roll_deg=-3.0, yaw_deg=30.0
)
UPWARD = load_camera("fisheye").altered(name="upward fisheye", optical_axis="up", xi=1.6)
CAMERAS = [*(load_camera(name) for name in camera_names()), TILTED, UPWARD]
SMALL = load_camera("paracatadioptric").resized(200, 150)
cameras = pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)


def small_picture(pose: Pose) -> bytes:
    view = GlRenderer(ROOM, SMALL)
    try:
        return view.render(pose, HEIGHT_M).tobytes()
    finally:
        view.close()


@pytest.fixture(scope="module")
def small() -> Iterator[GlRenderer]:
    view = GlRenderer(ROOM, SMALL)
    yield view
    view.close()


@cameras
def test_it_shows_what_the_rasteriser_shows(camera: CentralCamera) -> None:
    ours, theirs = GlRenderer(ROOM, camera), BulletRenderer(ROOM, camera)
    try:
        for pose in POSES[:2]:
            a = ours.render(pose, HEIGHT_M).astype(float)
            b = theirs.render(pose, HEIGHT_M).astype(float)
            assert np.array_equal(a > 0, b > 0)
            inside = a > 0
            assert np.abs(a - b)[inside].mean() < 4.0
            assert np.corrcoef(a[inside], b[inside])[0, 1] > 0.97
            # No part of the picture is out of place or missing.
            apart = cv2.blur(np.abs(a - b), (30, 30))
            assert apart.max() < 20.0
    finally:
        ours.close()
        theirs.close()


@cameras
def test_no_ray_slips_through(camera: CentralCamera) -> None:
    """In a closed room every pixel shows something: no seam, no gap between tiles."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    _, valid = camera.unproject(np.stack([u, v], axis=-1).astype(float))
    view = GlRenderer(ROOM, camera)
    try:
        for pose in POSES:
            assert np.array_equal(view.render(pose, HEIGHT_M) > 0, valid)
    finally:
        view.close()


def test_where_there_is_nothing_it_is_black(small: GlRenderer) -> None:
    """Far from the room, no rectangle is seen; nothing of the picture before is left."""
    assert small.render(POSES[0], HEIGHT_M).any()
    nowhere = small.render(Pose(0.0, 500.0, 0.0), HEIGHT_M)
    assert not nowhere.any()


def test_more_rays_a_pixel_come_nearer_to_the_truth(small: GlRenderer) -> None:
    finest, finer = (GlRenderer(ROOM, SMALL, detail) for detail in (4.0, 2.0))
    truth, better = (view.render(POSES[0], HEIGHT_M).astype(float) for view in (finest, finer))
    single = small.render(POSES[0], HEIGHT_M).astype(float)
    finest.close()
    finer.close()
    assert np.abs(better - truth).mean() < 0.7 * np.abs(single - truth).mean()


def test_renderers_do_not_disturb_each_other(small: GlRenderer) -> None:
    alone = [small.render(pose, HEIGHT_M) for pose in POSES]
    other = GlRenderer(ROOM.model_copy(update={"items": ()}), SMALL)
    empty = other.render(POSES[0], HEIGHT_M)
    assert not np.array_equal(empty, alone[0])
    for pose, before in zip(POSES, alone, strict=True):
        other.render(pose, HEIGHT_M)
        assert np.array_equal(small.render(pose, HEIGHT_M), before)
    other.close()
    assert np.array_equal(small.render(POSES[0], HEIGHT_M), alone[0])


def test_any_thread_may_draw(small: GlRenderer) -> None:
    pictures = []
    thread = threading.Thread(target=lambda: pictures.append(small.render(POSES[1], HEIGHT_M)))
    thread.start()
    thread.join()
    assert np.array_equal(pictures[0], small.render(POSES[1], HEIGHT_M))


def test_worker_processes_draw_the_same_bits(small: GlRenderer) -> None:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        theirs = pool.submit(small_picture, POSES[0]).result()
    assert theirs == small.render(POSES[0], HEIGHT_M).tobytes()


def test_a_closed_one_says_so_and_many_may_be_opened_in_turn() -> None:
    for _ in range(5):
        view = GlRenderer(ROOM, SMALL)
        view.close()
        view.close()
    with pytest.raises(RuntimeError, match="closed"):
        view.render(POSES[0], HEIGHT_M)


def test_a_scene_too_large_for_the_driver_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("visctrl.sim.render.gl_pass._most_texels", lambda context: 1024)
    with pytest.raises(InputError, match=r"allows 1024x1024: use a smaller scene or image"):
        GlRenderer(ROOM, SMALL)


def test_without_the_package_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gl_context, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"moderngl is not installed: pip install 'visctrl\[gl\]'"):
        choose_drawer("gl")
    with pytest.raises(InputError, match="pip install"):
        GlRenderer(ROOM, SMALL)


@pytest.mark.skipif(sys.platform != "linux", reason="Mesa's variables make the driver fail")
@pytest.mark.parametrize(
    "variable",
    [
        "__EGL_VENDOR_LIBRARY_FILENAMES=/none",
        "LIBGL_DRIVERS_PATH=/none",
        "MESA_GL_VERSION_OVERRIDE=2.1",
    ],
)
def test_without_a_driver_it_says_what_to_install(variable: str) -> None:
    name, value = variable.split("=")
    script = (
        "from visctrl.hal.errors import InputError\n"
        "from visctrl.sim.render.renderer_choice import choose_drawer\n"
        "try: choose_drawer('gl')\nexcept InputError as error: print(error)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, name: value},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert "renderer 'gl': no OpenGL 3.3 driver draws here" in done.stdout
    assert "libgl1-mesa-dri" in done.stdout


def test_a_driver_that_crashes_or_hangs_is_a_problem_of_the_probe_only(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(gl_context, "_PROBE", "import os; os.abort()")
    with pytest.raises(InputError, match="the OpenGL driver crashes or hangs: install one"):
        GlRenderer(ROOM, SMALL)
