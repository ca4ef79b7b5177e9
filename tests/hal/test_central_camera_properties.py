"""Properties that hold for every central camera: skewed, mirrored, tilted, off centre."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError

from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.models.unified import UnifiedCamera

Array = NDArray[np.float64]

focal = st.floats(80.0, 900.0)


@st.composite
def cameras(draw: st.DrawFn, xi: st.SearchStrategy[float] | None = None) -> UnifiedCamera:
    """Return a camera of any kind, skewed, mirrored, off centre and tilted."""
    kinds = st.one_of(st.just(0.0), st.floats(0.05, 0.99), st.just(1.0), st.floats(1.01, 2.5))
    fx = draw(focal)
    return UnifiedCamera(
        name="any",
        width=800,
        height=600,
        xi=draw(kinds if xi is None else xi),
        fx=draw(st.sampled_from([-1.0, 1.0])) * fx,
        fy=fx * draw(st.floats(0.9, 1.1)),
        cx=399.5 + draw(st.floats(-40.0, 40.0)),
        cy=299.5 + draw(st.floats(-40.0, 40.0)),
        skew=draw(st.floats(-5.0, 5.0)),
        optical_axis=draw(st.sampled_from(["forward", "down", "up"])),
        yaw_deg=draw(st.floats(-180.0, 180.0)),
        pitch_deg=draw(st.floats(-20.0, 20.0)),
        roll_deg=draw(st.floats(-20.0, 20.0)),
        min_polar_deg=draw(st.sampled_from([0.0, 30.0])),
        max_polar_deg=draw(st.floats(60.0, 150.0)),
    )


seeds = st.integers(0, 2**32 - 1)


def pixels_of(camera: UnifiedCamera, seed: int, count: int = 200) -> Array:
    rng = np.random.default_rng(seed)
    return rng.uniform((-0.5, -0.5), (camera.width - 0.5, camera.height - 0.5), (count, 2))


def directions(seed: int, count: int = 200) -> Array:
    rays = np.random.default_rng(seed).standard_normal((count, 3))
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


@given(camera=cameras(), seed=seeds)
def test_a_valid_pixel_returns_through_its_ray(camera: UnifiedCamera, seed: int) -> None:
    pixels = pixels_of(camera, seed)
    rays, valid = camera.unproject(pixels)
    assert np.allclose(np.linalg.norm(rays[valid], axis=-1), 1.0, atol=1e-12)
    back, seen = camera.project(rays[valid])
    # A pixel on the very rim may fall off it by rounding, no other.
    polar = np.degrees(np.arccos(np.clip(rays[valid][:, 2], -1, 1)))
    rim = np.minimum(polar - camera.min_polar_deg, camera.max_polar_deg - polar) < 1e-6
    assert (seen | rim).all()
    assert np.allclose(back[seen], pixels[valid][seen], atol=1e-6)


@given(camera=cameras(), seed=seeds)
def test_a_visible_ray_returns_through_its_pixel(camera: UnifiedCamera, seed: int) -> None:
    rays = directions(seed)
    pixels, seen = camera.robot_pixels(rays)
    back, valid = camera.robot_rays(pixels[seen])
    assert np.allclose(back, rays[seen], atol=1e-7)
    polar = np.degrees(np.arccos(np.clip((rays[seen] @ camera.rotation)[:, 2], -1, 1)))
    rim = np.minimum(polar - camera.min_polar_deg, camera.max_polar_deg - polar) < 1e-4
    assert (valid | rim).all()


@given(camera=cameras(), seed=seeds)
def test_what_is_not_seen_has_no_pixel_in_the_image(camera: UnifiedCamera, seed: int) -> None:
    rays = directions(seed)
    pixels, seen = camera.project(rays)
    polar = np.degrees(np.arccos(np.clip(rays[:, 2], -1, 1)))
    outside = (polar > camera.max_polar_deg + 1e-6) | (polar < camera.min_polar_deg - 1e-6)
    assert np.isnan(pixels[outside]).all()
    assert not seen[outside].any()
    # Behind the plane through the upper centre, or on the sphere's far side: no image either.
    limit = -1.0 / camera.xi if camera.xi > 1 else -camera.xi
    assert not seen[rays[:, 2] <= limit].any()
    u, v = pixels[seen, 0], pixels[seen, 1]
    assert ((u >= -0.5) & (u <= 799.5) & (v >= -0.5) & (v <= 599.5)).all()


@given(camera=cameras(xi=st.floats(1.05, 2.5)))
def test_beyond_the_image_circle_there_is_no_ray(camera: UnifiedCamera) -> None:
    radius = 1.0 / math.sqrt(camera.xi**2 - 1.0)
    for share, exists in ((0.999, True), (1.001, False)):
        turn = np.linspace(0.0, 2.0 * np.pi, 25)
        x, y = share * radius * np.cos(turn), share * radius * np.sin(turn)
        u = camera.fx * x + camera.skew * y + camera.cx
        rays, valid = camera.unproject(np.stack([u, camera.fy * y + camera.cy], axis=-1))
        assert np.isfinite(rays).all() == exists
        if not exists:
            assert not valid.any()


@given(camera=cameras(), seed=seeds)
def test_jacobian_is_the_derivative(camera: UnifiedCamera, seed: int) -> None:
    # Away from the plane where the model has no image, so that differences are accurate.
    rays = directions(seed)
    rays = rays[rays[:, 2] > 0.3 - min(camera.xi, 1.0 / max(camera.xi, 0.1))]
    wide = camera.altered(min_polar_deg=0.0, max_polar_deg=180.0)
    J = wide.jacobian(rays)
    step = 1e-6
    numeric = np.stack(
        [
            (wide.project(rays + step * e)[0] - wide.project(rays - step * e)[0]) / (2 * step)
            for e in np.eye(3)
        ],
        axis=-1,
    )
    scale = np.abs(J).max(axis=(-1, -2), keepdims=True)
    assert np.allclose(J / scale, numeric / scale, atol=1e-6)
    assert np.allclose(J @ rays[..., None] / scale, 0.0, atol=1e-12)


@given(seed=seeds, fx=focal, ratio=st.floats(0.8, 1.2))
def test_perspective_agrees_with_opencv(seed: int, fx: float, ratio: float) -> None:
    camera = UnifiedCamera(
        name="plain", width=640, height=480, xi=0.0, fx=fx, fy=fx * ratio, cx=310.0, cy=250.0
    )
    points = np.random.default_rng(seed).uniform((-2, -2, 1), (2, 2, 6), (50, 3))
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, None)[0].reshape(-1, 2)
    pixels, seen = camera.project(points)
    assert np.allclose(pixels, expected, atol=1e-8)
    inside = (np.abs(expected - [319.5, 239.5]) <= [320.0, 240.0]).all(axis=-1)
    assert (seen == inside).all()


@given(camera=cameras(), seed=seeds, scale=st.sampled_from([0.25, 0.5, 1.6, 2.0]))
def test_resizing_keeps_the_field_of_view(camera: UnifiedCamera, seed: int, scale: float) -> None:
    other = camera.resized(round(800 * scale), round(600 * scale))
    pixels = pixels_of(camera, seed)
    rays, valid = camera.unproject(pixels)
    # The same place in the image, counted from its outer corner.
    rays_other, valid_other = other.unproject((pixels + 0.5) * scale - 0.5)
    both = valid & valid_other
    assert np.allclose(rays[both], rays_other[both], atol=1e-9)
    polar = np.degrees(np.arccos(np.clip(rays[..., 2], -1, 1)))
    rim = np.minimum(np.abs(polar - camera.min_polar_deg), np.abs(camera.max_polar_deg - polar))
    assert ((valid == valid_other) | (rim < 1e-6)).all()


@given(camera=cameras())
def test_rotation_is_a_rotation(camera: UnifiedCamera) -> None:
    R = camera.rotation
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_mounting_angles_turn_the_view_as_they_say() -> None:
    ahead = load_camera("perspective")
    left = ahead.altered(yaw_deg=90.0)
    up = ahead.altered(pitch_deg=30.0)
    assert np.allclose(left.rotation[:, 2], [-1, 0, 0])
    assert np.allclose(up.rotation[:, 2], [0, math.cos(math.pi / 6), 0.5])


@pytest.mark.parametrize(
    "change",
    [{"xi": -0.1}, {"fx": math.nan}, {"fx": 0.0}, {"fy": 0.0}, {"min_polar_deg": 95.0}],
)
def test_nonsense_is_refused(change: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        load_camera("fisheye").altered(**change)
