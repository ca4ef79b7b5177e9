"""How far a pixel's noise turns a bearing, against noise thrown at it."""

import numpy as np
import pytest

from visctrl.hal.cameras.catalogue import camera_names, load_camera
from visctrl.hal.cameras.central import CentralCamera

TILTED = load_camera("hypercatadioptric").altered(pitch_deg=4.0, roll_deg=-3.0, yaw_deg=20.0)
OBLONG = load_camera("paracatadioptric").altered(fx=-170.0, fy=150.0, skew=2.0)
CAMERAS = [*(load_camera(name) for name in camera_names()), TILTED, OBLONG]


@pytest.mark.parametrize("camera", CAMERAS, ids=[*camera_names(), "tilted", "oblong"])
def test_it_is_the_spread_of_bearings_of_noisy_pixels(camera: CentralCamera) -> None:
    rng = np.random.default_rng(5)
    pixels = rng.uniform([0, 0], [camera.width, camera.height], (400, 2))
    rays, valid = camera.robot_rays(pixels)
    pixels, rays = pixels[valid][:40], rays[valid][:40]
    sigma = 0.01
    noisy = pixels + rng.normal(0.0, sigma, (4000, *pixels.shape))
    seen, _ = camera.robot_rays(noisy)
    cross = seen[..., 0] * rays[:, 1] - seen[..., 1] * rays[:, 0]
    dot = seen[..., 0] * rays[:, 0] + seen[..., 1] * rays[:, 1]
    spread = np.arctan2(cross, dot).std(axis=0)
    assert len(rays) > 20
    np.testing.assert_allclose(sigma * camera.bearing_per_pixel(rays), spread, rtol=0.06)
