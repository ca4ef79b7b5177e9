"""The central camera against the textbook models that it contains, and against itself."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from visctrl.hal.cameras.catalogue import camera_names, load_camera
from visctrl.hal.cameras.models.unified import UnifiedCamera
from visctrl.robots.errors import InputError

RNG = np.random.default_rng(0)
MODELS = [load_camera(name) for name in camera_names()] + [
    UnifiedCamera(
        name="odd",
        width=640,
        height=512,
        xi=2.1,
        fx=-900.0,
        fy=870.0,
        cx=300.0,
        cy=260.0,
        skew=3.0,
        optical_axis="up",
        yaw_deg=25.0,
        pitch_deg=-4.0,
        roll_deg=3.0,
        max_polar_deg=110.0,
    )
]
models = pytest.mark.parametrize("camera", MODELS, ids=lambda camera: camera.name)


def valid_pixels(camera: UnifiedCamera, count: int = 2000) -> np.ndarray[tuple[int, int]]:
    pixels = RNG.uniform((0, 0), (camera.width - 1, camera.height - 1), size=(count, 2))
    kept = pixels[camera.unproject(pixels)[1]]
    assert len(kept) > 100
    return kept


def simple(xi: float, **changes: float) -> UnifiedCamera:
    base = {"width": 2001, "height": 2001, "fx": 100, "fy": 100, "cx": 1000, "cy": 1000}
    return UnifiedCamera.model_validate(
        {"name": "simple", "xi": xi, "max_polar_deg": 80.0, **base, **changes}
    )


@models
def test_pixels_and_rays_are_inverse_to_each_other(camera: UnifiedCamera) -> None:
    pixels = valid_pixels(camera)
    rays, _ = camera.unproject(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    again, valid = camera.project(rays * RNG.uniform(0.1, 50.0, size=(len(rays), 1)))
    assert valid.all()
    np.testing.assert_allclose(again, pixels, atol=1e-8)
    robot, valid = camera.robot_rays(pixels)
    assert valid.all()
    np.testing.assert_allclose(camera.robot_pixels(robot)[0], pixels, atol=1e-8)


@models
def test_what_projects_is_what_unprojects(camera: UnifiedCamera) -> None:
    """No ray outside the field gets a valid pixel, no valid pixel a ray outside."""
    rays = RNG.normal(size=(5000, 3))
    pixels, valid = camera.project(rays)
    back, seen = camera.unproject(pixels[valid])
    assert seen.all()
    unit = rays[valid] / np.linalg.norm(rays[valid], axis=1, keepdims=True)
    np.testing.assert_allclose(back, unit, atol=1e-9)
    polar = np.degrees(np.arccos(unit[:, 2]))
    assert polar.min() >= camera.min_polar_deg - 1e-6
    assert polar.max() <= camera.max_polar_deg + 1e-6


@models
def test_the_jacobian_is_the_derivative_of_the_projection(camera: UnifiedCamera) -> None:
    rays, _ = camera.unproject(valid_pixels(camera)[:200])
    jacobian = camera.jacobian(rays)
    step = 1e-6
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = step
        plain = camera.altered(min_polar_deg=0.0, max_polar_deg=min(camera.max_polar_deg + 1, 180))
        slope = (plain.project(rays + shift)[0] - plain.project(rays - shift)[0]) / (2 * step)
        scale = np.abs(jacobian).max()
        np.testing.assert_allclose(jacobian[..., axis], slope, atol=1e-6 * scale)
    along = np.einsum("nij,nj->ni", jacobian, rays)
    np.testing.assert_allclose(along, 0.0, atol=1e-8)


@given(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2), st.floats(0.3, 9.0))
def test_xi_0_is_the_pinhole(x: float, y: float, z: float) -> None:
    pixel, _ = simple(0.0).project((x * z, y * z, z))
    assert pixel == pytest.approx((100 * x + 1000, 100 * y + 1000))


@given(st.floats(0.01, 1.39), st.floats(-math.pi, math.pi))
def test_xi_1_is_the_stereographic_projection_of_a_parabolic_mirror(
    polar: float, azimuth: float
) -> None:
    s = math.sin(polar)
    ray = (s * math.cos(azimuth), s * math.sin(azimuth), math.cos(polar))
    radius = 100 * math.tan(polar / 2)
    expected = (1000 + radius * math.cos(azimuth), 1000 + radius * math.sin(azimuth))
    assert simple(1.0).project(ray)[0] == pytest.approx(expected, abs=1e-9)


def test_xi_above_1_has_an_image_circle_and_no_rays_outside() -> None:
    xi = 1.5
    camera = simple(xi, max_polar_deg=180.0)
    edge = 100 / math.sqrt(xi**2 - 1)
    for radius, inside in ((0.999 * edge, True), (1.001 * edge, False)):
        ray, valid = camera.unproject((1000 + radius, 1000))
        assert bool(valid) is inside
        assert bool(np.isfinite(ray).all()) is inside
    # At the circle rays graze the sphere: cos of the polar angle is −1/ξ; none lies behind.
    grazing = math.acos(-1 / xi)
    for polar, seen in ((grazing - 0.01, True), (grazing + 0.01, False)):
        assert bool(camera.project((math.sin(polar), 0.0, math.cos(polar)))[1]) is seen


@pytest.mark.parametrize(
    ("axis", "pixel", "expected"),
    [
        ("forward", (1000, 1000), (0, 1, 0)),
        ("forward", (1100, 1000), (0.5**0.5, 0.5**0.5, 0)),
        ("forward", (1000, 900), (0, 0.5**0.5, 0.5**0.5)),
        ("down", (1000, 1000), (0, 0, -1)),
        ("down", (1000, 900), (0, 0.5**0.5, -(0.5**0.5))),
        ("down", (1100, 1000), (0.5**0.5, 0, -(0.5**0.5))),
        ("up", (1000, 1000), (0, 0, 1)),
        ("up", (1000, 1100), (0, 0.5**0.5, 0.5**0.5)),
        ("up", (1100, 1000), (0.5**0.5, 0, 0.5**0.5)),
    ],
)
def test_mountings(
    axis: str, pixel: tuple[float, float], expected: tuple[float, float, float]
) -> None:
    camera = simple(0.0).altered(optical_axis=axis)
    np.testing.assert_allclose(camera.robot_rays(pixel)[0], expected, atol=1e-12)


def test_a_yawed_mount_turns_every_bearing_by_the_yaw() -> None:
    straight = load_camera("hypercatadioptric")
    turned = straight.altered(yaw_deg=30.0)
    pixels = valid_pixels(straight)
    a, b = straight.robot_rays(pixels)[0], turned.robot_rays(pixels)[0]
    np.testing.assert_allclose(a[:, 2], b[:, 2], atol=1e-12)
    turn = np.arctan2(a[:, 0], a[:, 1]) - np.arctan2(b[:, 0], b[:, 1])
    np.testing.assert_allclose(np.angle(np.exp(1j * turn)), math.radians(30.0), atol=1e-9)


def test_catadioptric_elevation_grows_outwards() -> None:
    camera = load_camera("hypercatadioptric")
    radii = np.arange(60.0, 280.0)
    rays, valid = camera.robot_rays(np.column_stack([camera.cx + radii, np.full(220, camera.cy)]))
    elevation = rays[valid][:, 2]
    assert (np.diff(elevation) > 0).all()
    assert elevation.min() < -0.6
    assert elevation.max() > 0.4


@models
def test_another_size_keeps_the_field_of_view(camera: UnifiedCamera) -> None:
    half = camera.resized(camera.width // 2, camera.height // 2)
    pixels = valid_pixels(camera)
    smaller = (pixels + 0.5) / 2 - 0.5
    np.testing.assert_allclose(half.unproject(smaller)[0], camera.unproject(pixels)[0], atol=1e-12)
    with pytest.raises(InputError, match="aspect ratio"):
        camera.resized(camera.width, camera.height // 2)


def test_leading_axes_broadcast() -> None:
    camera = load_camera("fisheye")
    rays = RNG.normal(size=(4, 5, 3))
    pixels, valid = camera.project(rays)
    assert pixels.shape == (4, 5, 2)
    assert valid.shape == (4, 5)
    one, ok = camera.project(rays[2, 3])
    np.testing.assert_array_equal(one, pixels[2, 3])
    assert ok == valid[2, 3]
    assert camera.jacobian(rays).shape == (4, 5, 2, 3)


def test_unknown_cameras_are_refused_with_a_suggestion() -> None:
    with pytest.raises(InputError, match="did you mean 'fisheye'"):
        load_camera("fish-eye")
