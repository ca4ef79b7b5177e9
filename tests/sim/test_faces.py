"""Face layouts: every pixel of a camera is drawn, in the right direction, finely enough."""

import numpy as np
import pytest
from numpy.typing import NDArray

from visctrl.hal.cameras.catalogue import camera_names, load_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.sim.render.view_atlas import FaceLayout, PixelOrigin, plan_faces

Array = NDArray[np.float64]

TINY = PixelOrigin(0.0, 1.0)
CAMERAS = [load_camera(name) for name in camera_names()] + [
    load_camera("hypercatadioptric").altered(
        name="mirrored", fx=-117.0, skew=2.0, pitch_deg=4.0, roll_deg=-3.0, yaw_deg=30.0
    ),
    load_camera("fisheye").altered(
        name="upward fisheye", optical_axis="up", xi=1.8, fx=500, fy=500
    ),
    load_camera("perspective").altered(name="wide", fx=250, fy=250, max_polar_deg=70, xi=0.2),
]
cameras = pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)


def image_rays(camera: CentralCamera) -> tuple[Array, NDArray[np.bool_]]:
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(float)
    return camera.unproject(np.stack([u, v], axis=-1))


def atlas_places(layout: FaceLayout) -> Array:
    """Return where in the atlas each pixel of the image is taken from (column, row)."""
    whole = layout.map_xy.astype(float)
    fraction = layout.map_fraction
    return np.asarray(whole + np.stack([fraction & 31, fraction >> 5], axis=-1) / 32.0)


@cameras
@pytest.mark.parametrize("origin", [TINY, PixelOrigin(0.5, 0.5)])
def test_each_pixel_is_taken_from_its_own_direction(
    camera: CentralCamera, origin: PixelOrigin
) -> None:
    layout = plan_faces(camera, origin)
    rays, valid = image_rays(camera)
    assert (layout.outside == ~valid).all()
    places = atlas_places(layout)
    left = valid.copy()
    for face in layout.faces:
        column, row = places[..., 0], places[..., 1] - face.row
        # Both neighbours that interpolation reads belong to the face.
        on_face = (column >= 0) & (column <= face.width - 1) & (row >= 0) & (row <= face.height - 1)
        mine = left & on_face
        left &= ~mine
        scale = np.array(
            [
                (face.right - face.left) / face.width,
                (face.top - face.bottom) / face.height,
            ]
        )
        x = face.left + (column[mine] + origin.column) * scale[0]
        y = face.top - (row[mine] + origin.row) * scale[1]
        eye = np.stack([x, y, -np.ones_like(x)], axis=-1) @ face.rotation.T
        eye /= np.linalg.norm(eye, axis=-1, keepdims=True)
        # Maps are in 1/32 px of the face.
        assert np.linalg.norm(eye - rays[mine], axis=-1).max() < 0.03 * scale.max()
    assert not left.any()


@cameras
def test_faces_are_as_fine_as_the_image_needs_and_not_much_finer(camera: CentralCamera) -> None:
    layout = plan_faces(camera, TINY)
    _, valid = image_rays(camera)
    assert 0.9 * valid.sum() < layout.pixels < 1.45 * valid.sum()
    places = atlas_places(layout)
    jump = np.abs(np.diff(places, axis=1)).max(axis=-1)
    both = valid[:, 1:] & valid[:, :-1] & (jump < 10)
    # A step of one image pixel is about one face pixel in the median.
    assert 0.7 < np.median(jump[both]) < 1.2


@pytest.mark.parametrize("name", ["fisheye", "paracatadioptric"])
def test_detail_scales_the_faces(name: str) -> None:
    camera = load_camera(name)
    whole = plan_faces(camera, TINY)
    half = plan_faces(camera, TINY, detail=0.5)
    assert half.pixels == pytest.approx(whole.pixels / 4, rel=0.1)


def test_a_perspective_camera_is_drawn_pixel_by_pixel() -> None:
    layout = plan_faces(load_camera("perspective"), TINY)
    assert len(layout.faces) == 1
    assert (layout.map_fraction == 0).all()
    face = layout.faces[0]
    atlas = np.random.default_rng(0).integers(0, 255, layout.size).astype(np.uint8)
    assert np.array_equal(layout.compose(atlas), atlas[1 : face.height - 1, 1 : face.width - 1])


def test_face_rays_and_frustum_agree() -> None:
    for face in plan_faces(load_camera("paracatadioptric"), PixelOrigin(0.5, 0.5)).faces:
        rays = face.rays(PixelOrigin(0.5, 0.5)) @ face.rotation
        x, y = rays[..., 0] / -rays[..., 2], rays[..., 1] / -rays[..., 2]
        half = (face.right - face.left) / face.width / 2
        assert x[0, 0] - half == pytest.approx(face.left)
        assert x[-1, -1] + half == pytest.approx(face.right)
        assert y[0, 0] < face.top
        assert y[-1, -1] > face.bottom
        assert np.allclose(face.rotation @ face.rotation.T, np.eye(3))
        assert np.linalg.det(face.rotation) == pytest.approx(1.0)
