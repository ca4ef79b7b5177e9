from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from visctrl.contracts import Array, Context, Health
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.types import Features, Frame
from visctrl.perception.features import FeaturesOptions, IdentifiedFeatures
from visctrl.robots.errors import InputError

CAMERA = load_camera("hypercatadioptric")
CONTEXT = Context(CAMERA, None, 0.0, 0.1, 0, True)
RNG = np.random.default_rng(0)
COUNT = 40
BEARINGS = RNG.uniform(-math.pi, math.pi, COUNT)
RAYS = np.column_stack([np.sin(BEARINGS), np.cos(BEARINGS), RNG.uniform(-0.4, 0.4, COUNT)])
RAYS /= np.linalg.norm(RAYS, axis=1)[:, None]
PIXELS: Array = CAMERA.robot_pixels(RAYS)[0]


def frame(ids: Sequence[int], pixels: Array | None = None, stamp: float = 0.0) -> Frame:
    shown = PIXELS[list(ids)] if pixels is None else pixels
    return Frame(stamp, 1, features=Features(np.array(ids, dtype=np.int64), shown))


def perception(**options: float) -> IdentifiedFeatures:
    return IdentifiedFeatures(FeaturesOptions(**options), CONTEXT)  # type: ignore[arg-type]


def test_views_are_the_rays_of_the_features_that_all_three_show() -> None:
    plugin = perception()
    plugin.set_target([frame(range(0, 30))])
    match = plugin.set_initial(frame(range(5, 35)))
    assert (match.candidates, match.inliers) == (25, 25)
    np.testing.assert_array_equal(match.target_pixels, PIXELS[5:30])
    np.testing.assert_array_equal(match.initial_pixels, PIXELS[5:30])
    views = plugin.update(frame(range(10, 40), stamp=3.5))
    assert views.ids.tolist() == list(range(10, 30))
    assert views.stamp == 3.5
    assert views.health is Health.OK
    for rays in (views.target, views.initial, views.current):
        np.testing.assert_allclose(rays, RAYS[10:30], atol=1e-12)
    np.testing.assert_array_equal(views.pixels, PIXELS[10:30])


def test_target_frames_are_averaged_and_rare_features_dropped() -> None:
    plugin = perception()
    wide, shift = list(range(20)), np.array([[0.3, -0.2]])
    frames = [
        frame(wide, PIXELS[:20] + shift),
        frame(wide, PIXELS[:20] - shift),
        frame(range(12)),
    ]
    plugin.set_target([*frames, frame(range(12))])
    match = plugin.set_initial(frame(wide))
    np.testing.assert_allclose(match.target_pixels, PIXELS[:12], atol=1e-12)


def test_too_few_features_are_lost_and_come_back() -> None:
    plugin = perception(min_features=10)
    plugin.set_target([frame(range(30))])
    plugin.set_initial(frame(range(30)))
    lost = plugin.update(frame(range(7)))
    assert lost.health is Health.LOST
    assert lost.reason == "7 features of 10 needed"
    assert plugin.update(frame([])).health is Health.LOST
    assert plugin.update(frame(range(10))).health is Health.OK


def test_pixels_without_a_ray_are_left_out() -> None:
    plugin = perception()
    plugin.set_target([frame(range(30))])
    plugin.set_initial(frame(range(30)))
    moved = PIXELS[:30].copy()
    moved[4] = (CAMERA.cx, CAMERA.cy)
    assert 4 not in plugin.update(frame(range(30), moved)).ids


def test_views_that_cannot_serve_are_refused_with_numbers() -> None:
    plugin = perception(min_features=12)
    with pytest.raises(InputError, match="target view shows 5 features, 12 are needed"):
        plugin.set_target([frame(range(5))])
    plugin.set_target([frame(range(20))])
    with pytest.raises(InputError, match="not recognised from here: it shares 5 features, 12"):
        plugin.set_initial(frame(range(15, 40)))


def test_images_are_sent_to_the_plugin_that_reads_them() -> None:
    image = np.zeros((600, 800), dtype=np.uint8)
    with pytest.raises(InputError, match="'klt'"):
        perception().set_target([Frame(0.0, 1, image=image)])


def test_sigma_is_the_noise_of_a_bearing() -> None:
    """Against the spread of bearings of features that are really moved by noise."""
    noise = 0.8
    plugin = perception(noise_px=noise)
    plugin.set_target([frame(range(COUNT))])
    plugin.set_initial(frame(range(COUNT)))
    sigma = plugin.update(frame(range(COUNT))).sigma
    rng = np.random.default_rng(1)
    moved = PIXELS[None] + rng.normal(scale=noise, size=(4000, *PIXELS.shape))
    rays, _ = CAMERA.robot_rays(moved)
    error = np.angle(
        np.exp(1j * (np.arctan2(rays[..., 0], rays[..., 1]) - np.arctan2(RAYS[:, 0], RAYS[:, 1])))
    )
    assert sigma == pytest.approx(np.median(error.std(axis=0)), rel=0.03)
