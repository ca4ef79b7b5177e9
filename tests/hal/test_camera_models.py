"""Every projection model: inverse, derivative, region, and OpenCV or published formulas."""

from __future__ import annotations

import math
import sys

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.hal.camera_models import BASE, STRATEGIES
from visctrl.hal.cameras.catalogue import model_class, model_names, parse_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.models.double_sphere import DoubleSphereCamera
from visctrl.hal.cameras.models.extended_unified import ExtendedUnifiedCamera
from visctrl.hal.cameras.models.kannala_brandt import KannalaBrandtCamera
from visctrl.hal.cameras.models.ocam import OcamCamera
from visctrl.hal.cameras.models.pinhole_radtan import PinholeRadtanCamera
from visctrl.hal.cameras.models.unified import UnifiedCamera
from visctrl.hal.cameras.models.unified_radtan import UnifiedRadtanCamera
from visctrl.robots.errors import InputError

Array = NDArray[np.float64]
every = pytest.mark.parametrize("name", sorted(STRATEGIES))
few = settings(max_examples=15, deadline=None)
data = st.data()


def grid(camera: CentralCamera) -> Array:
    """Return pixels all over the picture, its outermost edges included."""
    u = np.linspace(-0.499, camera.width - 0.501, 41)
    v = np.linspace(-0.499, camera.height - 0.501, 31)
    return np.stack(np.meshgrid(u, v), axis=-1)


def directions(seed: int, count: int = 400) -> Array:
    rays = np.random.default_rng(seed).standard_normal((count, 3))
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def test_every_model_is_tested() -> None:
    assert sorted(STRATEGIES) == sorted(model_names())


@every
@given(data=data)
@few
def test_pixels_return_through_their_rays_to_1e_9(name: str, data: st.DataObject) -> None:
    camera = data.draw(STRATEGIES[name])
    pixels = grid(camera)
    rays, valid = camera.unproject(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays[valid], axis=-1), 1.0, atol=1e-12)
    back, seen = camera.project(rays[valid])
    # A ray within rounding of the rim may fall off it.
    rim = np.abs(rays[valid][:, 2] - camera.field[0]) < 1e-8
    assert (seen | rim | ~camera.contains(back)).all()
    inside = np.isfinite(back).all(axis=-1)
    np.testing.assert_allclose(back[inside], pixels[valid][inside], atol=1e-9, rtol=0)


@every
@given(data=data, seed=st.integers(0, 2**32 - 1))
@few
def test_rays_return_through_their_pixels(name: str, data: st.DataObject, seed: int) -> None:
    camera = data.draw(STRATEGIES[name])
    rays = directions(seed)
    pixels, seen = camera.project(7.0 * rays)
    back, valid = camera.unproject(pixels[seen])
    rim = np.abs(rays[seen][:, 2] - camera.field[0]) < 1e-6
    assert (valid | rim).all()
    # Near the rim a pixel turns the ray by much: compare where it does not.
    np.testing.assert_allclose(back[~rim], rays[seen][~rim], atol=1e-7)


@every
@given(data=data, azimuth=st.floats(0, 2 * math.pi))
@few
def test_the_image_moves_outwards_up_to_the_limit(
    name: str, data: st.DataObject, azimuth: float
) -> None:
    """No two rays of a half plane through the axis share a pixel, and beyond there is none."""
    camera = data.draw(STRATEGIES[name]).altered(max_polar_deg=180.0)
    limit = math.acos(max(-1.0, camera.limit))
    theta = np.linspace(0.0, 0.9995 * limit, 300)
    across = np.array([math.cos(azimuth), math.sin(azimuth)])
    rays = np.column_stack([np.sin(theta)[:, None] * across, np.cos(theta)])
    pixels, _ = camera.project(rays)
    assert np.isfinite(pixels).all()
    plane = (pixels - [camera.cx, camera.cy]) @ np.linalg.inv(camera.K[:2, :2]).T
    assert (np.diff(np.hypot(*plane.T)) > 0.0).all()
    if limit < math.pi - 0.05:
        beyond = limit + 0.02
        ray = [*(math.sin(beyond) * across), math.cos(beyond)]
        assert np.isnan(camera.project(ray)[0]).all()


@every
@given(data=data, seed=st.integers(0, 2**32 - 1))
@few
def test_the_jacobian_is_the_derivative(name: str, data: st.DataObject, seed: int) -> None:
    camera = data.draw(STRATEGIES[name]).altered(max_polar_deg=180.0)
    rays = directions(seed, 200)
    rays = np.concatenate([rays, [[0.0, 0.0, 1.0], [1e-9, 0.0, 1.0]]])
    rays = rays[rays[:, 2] > camera.field[0] + 0.05]
    J = camera.jacobian(rays)
    step = 1e-6
    numeric = np.stack(
        [
            (camera.project(rays + step * e)[0] - camera.project(rays - step * e)[0]) / (2 * step)
            for e in np.eye(3)
        ],
        axis=-1,
    )
    scale = np.abs(J).max(axis=(-1, -2), keepdims=True)
    np.testing.assert_allclose(J / scale, numeric / scale, atol=2e-6)
    np.testing.assert_allclose(J @ rays[..., None] / scale, 0.0, atol=1e-9)


@every
@given(data=data)
@few
def test_another_size_and_a_mirrored_picture_have_the_same_rays(
    name: str, data: st.DataObject
) -> None:
    camera = data.draw(STRATEGIES[name])
    pixels = grid(camera)[1:-1, 1:-1]
    rays, valid = camera.unproject(pixels)
    half = camera.resized(320, 240)
    np.testing.assert_allclose(
        half.unproject((pixels + 0.5) / 2 - 0.5)[0][valid], rays[valid], atol=1e-9
    )
    mirrored = camera.stretched(-1.0, 1.0).altered(cx=camera.width - 1 - camera.cx)
    other = np.stack([camera.width - 1 - pixels[..., 0], pixels[..., 1]], axis=-1)
    np.testing.assert_allclose(mirrored.unproject(other)[0][valid], rays[valid], atol=1e-9)


@every
@given(data=data, seed=st.integers(0, 2**32 - 1))
@few
def test_documents_keep_a_camera_exactly(name: str, data: st.DataObject, seed: int) -> None:
    camera = data.draw(STRATEGIES[name])
    again = parse_camera(camera.model_dump(mode="json"), "test")
    assert again == camera
    assert type(again) is model_class(name)


@given(camera=STRATEGIES["pinhole-radtan"], seed=st.integers(0, 2**32 - 1))
@few
def test_radial_tangential_is_opencv_s(camera: PinholeRadtanCamera, seed: int) -> None:
    camera = camera.altered(skew=0.0, max_polar_deg=89.0)
    points = np.random.default_rng(seed).uniform((-1, -1, 1), (1, 1, 4), (100, 3))
    D = np.array(list(camera.coefficients.values()))
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, D)[0].reshape(-1, 2)
    pixels, _ = camera.project(points)
    seen = np.isfinite(pixels).all(axis=-1)
    np.testing.assert_allclose(pixels[seen], expected[seen], atol=1e-8)


@given(camera=STRATEGIES["kannala-brandt"], seed=st.integers(0, 2**32 - 1))
@few
def test_kannala_brandt_is_opencv_s_fisheye(camera: KannalaBrandtCamera, seed: int) -> None:
    camera = camera.altered(skew=0.0, max_polar_deg=80.0)
    points = np.random.default_rng(seed).uniform((-2, -2, 1), (2, 2, 4), (100, 1, 3))
    D = np.array(list(camera.coefficients.values()))
    expected = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, D)[0][:, 0]
    pixels, _ = camera.project(points[:, 0])
    seen = np.isfinite(pixels).all(axis=-1)
    assert seen.any()
    np.testing.assert_allclose(pixels[seen], expected[seen], atol=1e-8)


@given(camera=STRATEGIES["unified-radtan"], seed=st.integers(0, 2**32 - 1))
@few
def test_mei_s_model_is_opencv_s_distortion_after_the_sphere(
    camera: UnifiedRadtanCamera, seed: int
) -> None:
    camera = camera.altered(skew=0.0, max_polar_deg=180.0)
    rays = directions(seed)
    pixels, _ = camera.project(rays)
    seen = np.isfinite(pixels).all(axis=-1)
    shifted = rays[seen] + [0.0, 0.0, camera.xi]
    D = np.array([camera.k1, camera.k2, camera.p1, camera.p2])
    expected = cv2.projectPoints(shifted, np.zeros(3), np.zeros(3), camera.K, D)[0][:, 0]
    np.testing.assert_allclose(pixels[seen], expected, rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("xi", [0.4, 0.9, 1.0])
def test_models_agree_where_one_contains_the_other(xi: float) -> None:
    rays = directions(3)
    share = xi / (1.0 + xi)
    unified = UnifiedCamera(**BASE, xi=xi, fx=300.0, fy=290.0, max_polar_deg=100.0)
    expected, seen = unified.project(rays)
    fields = {**BASE, "max_polar_deg": 100.0, "fx": 300.0 * (1 - share), "fy": 290.0 * (1 - share)}
    cameras = [
        UnifiedRadtanCamera(**{**fields, "fx": 300.0, "fy": 290.0}, xi=xi),
        DoubleSphereCamera(**fields, xi=0.0, alpha=share),
        DoubleSphereCamera(**{**fields, "fx": 300.0, "fy": 290.0}, xi=xi, alpha=0.0),
        ExtendedUnifiedCamera(**fields, alpha=share, beta=1.0),
    ]
    for camera in cameras:
        pixels, valid = camera.project(rays)
        np.testing.assert_array_equal(valid, seen)
        np.testing.assert_allclose(pixels[seen], expected[seen], atol=1e-9)


def test_a_parabolic_mirror_is_ocam_s_polynomial_of_second_degree() -> None:
    """cot θ = (1 − t²)/2t with t = tan(θ/2) = ρ/f: z = f/2 − ρ²/2f."""
    f = 200.0
    unified = UnifiedCamera(**BASE, xi=1.0, fx=f, fy=f, max_polar_deg=100.0)
    ocam = OcamCamera(**BASE, polynomial=(f / 2, 0.0, -0.5 / f), max_polar_deg=100.0)
    rays = directions(4)
    (expected, seen), (pixels, valid) = unified.project(rays), ocam.project(rays)
    np.testing.assert_array_equal(valid, seen)
    np.testing.assert_allclose(pixels[seen], expected[seen], atol=1e-9)


@given(polar=st.floats(0.01, 3.1), azimuth=st.floats(-3.1, 3.1))
def test_kannala_brandt_without_coefficients_is_equidistant(polar: float, azimuth: float) -> None:
    camera = KannalaBrandtCamera(**BASE, fx=50.0, fy=50.0, max_polar_deg=180.0)
    across = np.array([math.cos(azimuth), math.sin(azimuth)])
    pixel, _ = camera.project([*(math.sin(polar) * across), math.cos(polar)])
    np.testing.assert_allclose(pixel, [322.3, 236.1] + 50.0 * polar * across, atol=1e-9)


@every
@given(data=data, seed=st.integers(0, 2**32 - 1))
@few
def test_bearings_of_a_pixel_are_their_differences(
    name: str, data: st.DataObject, seed: int
) -> None:
    """The general propagation against differences of bearings."""
    camera = data.draw(STRATEGIES[name]).altered(yaw_deg=20.0, pitch_deg=-7.0, roll_deg=3.0)
    pixels = np.random.default_rng(seed).uniform((20, 20), (620, 460), (50, 2))
    rays, valid = camera.robot_rays(pixels)
    valid &= np.hypot(rays[:, 0], rays[:, 1]) > 0.2
    valid &= (rays @ camera.rotation)[:, 2] > camera.field[0] + 0.1
    pixels, rays = pixels[valid], rays[valid]
    step = 1e-4
    slopes = []
    for e in np.eye(2):
        a, b = (camera.robot_rays(pixels + s * step * e)[0] for s in (1, -1))
        turn = np.arctan2(a[:, 0], a[:, 1]) - np.arctan2(b[:, 0], b[:, 1])
        slopes.append(np.angle(np.exp(1j * turn)) / (2 * step))
    expected = np.hypot(*slopes)
    np.testing.assert_allclose(camera.bearing_per_pixel(rays), expected, rtol=1e-4)


class EquisolidCamera(KannalaBrandtCamera):
    """A model from outside of the package: r = 2 sin(θ/2)."""

    model: str = f"{__name__}:EquisolidCamera"  # type: ignore[assignment]

    def _radius(self, theta: Array) -> Array:
        return 2.0 * np.sin(theta / 2.0)

    def _slope(self, theta: Array) -> Array:
        return np.cos(theta / 2.0)


def test_a_model_from_outside_is_named_by_module_and_class() -> None:
    assert __name__ in sys.modules
    data = {**BASE, "model": f"{__name__}:EquisolidCamera", "fx": 200.0, "fy": 200.0}
    camera = parse_camera(data, "mine.yaml")
    pixels = grid(camera)
    rays, valid = camera.unproject(pixels)
    assert valid.sum() > 100
    np.testing.assert_allclose(camera.project(rays[valid])[0], pixels[valid], atol=1e-9)


@pytest.mark.parametrize(
    ("model", "complaint"),
    [
        ("fisheye", "mine.yaml: unknown model 'fisheye'; known: double-sphere"),
        ("no.such:Camera", "mine.yaml: model 'no.such:Camera' cannot be loaded"),
        ("math:pi", "is not derived from CentralCamera"),
    ],
)
def test_models_that_are_none(model: str, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        parse_camera({**BASE, "model": model}, "mine.yaml")


@pytest.mark.parametrize(
    ("model", "changes"),
    [
        ("double-sphere", {"xi": 1.2, "alpha": 0.5}),
        ("double-sphere", {"xi": 0.1, "alpha": 1.5}),
        ("extended-unified", {"alpha": 0.5, "beta": 0.0}),
        ("kannala-brandt", {"k1": math.nan}),
        ("unified-radtan", {"xi": -0.5}),
        ("pinhole-radtan", {"k7": 0.0}),
    ],
)
def test_parameters_that_are_none(model: str, changes: dict[str, float]) -> None:
    data = {**BASE, "fx": 300.0, "fy": 300.0, "model": model, **changes}
    with pytest.raises(InputError, match=r"mine.yaml: .*key '"):
        parse_camera(data, "mine.yaml")
