from __future__ import annotations

import threading

import numpy as np
import pytest
from box_room import wall
from driving import AHEAD, START, TARGET, bearing_errors, context, frames, line, room
from driving import tracker as shown_the_target

from visctrl.contracts import Health, Views
from visctrl.hal.errors import InputError
from visctrl.hal.types import Features, Frame, Pose
from visctrl.perception.klt import Klt, KltOptions

NAME, WIDTH = "hypercatadioptric", 400


@pytest.fixture(scope="module")
def drive():
    """Return a drive to the target and its frames."""
    poses = line(START, TARGET, 14)
    return poses, list(frames(NAME, poses, WIDTH))


@pytest.fixture
def tracker():
    """Return a function that makes trackers shown the target; all are closed at the end."""
    made: list[Klt] = []

    def make(name: str = NAME, width: int | None = WIDTH, **options: float) -> Klt:
        made.append(shown_the_target(name, width, **options))
        return made[-1]

    yield make
    for klt in made:
        klt.close()


def dark(number: int) -> Frame:
    """Return a frame of a covered lens: noise only."""
    camera = room(NAME, WIDTH).camera
    noise = np.random.default_rng(number).normal(3.0, 2.0, (camera.height, camera.width))
    return Frame(0.1 * number, number, noise.clip(0, 255).astype(np.uint8))


def same(a: Views, b: Views) -> bool:
    return all(
        np.array_equal(getattr(a, field), getattr(b, field))
        for field in ("ids", "target", "initial", "current", "pixels", "sigma")
    )


@pytest.mark.parametrize(
    ("name", "start"),
    [
        ("hypercatadioptric", START),
        ("paracatadioptric", START),
        ("fisheye", START),
        ("perspective", AHEAD),
    ],
)
def test_bearings_agree_with_the_scene_all_the_way(tracker, name, start):
    width = 320 if name == "perspective" else WIDTH
    klt, poses = tracker(name, width), line(start, TARGET, 14)
    for number, (pose, frame) in enumerate(zip(poses, frames(name, poses, width), strict=True)):
        if number == 0:
            assert klt.set_initial(frame).inliers > 100
        views = klt.update(frame)
        error = bearing_errors(views, pose, room(name, width))
        assert views.health is Health.OK
        assert len(views) >= 100
        assert np.median(error) < 0.08
        assert np.mean(error > 0.5) <= 0.03
        assert views.stamp == frame.stamp
    assert np.median(error) < 0.02
    assert np.percentile(error, 95) < 0.1
    drawn, _ = room(name, width).camera.robot_pixels(views.current)
    np.testing.assert_allclose(views.pixels, drawn, atol=1e-6)


def test_sigma_is_what_the_bearings_scatter_by(tracker, drive):
    poses, _ = drive
    for noise in (2.0, 12.0):
        klt = tracker()
        noisy = [room(NAME, WIDTH).frame(p, 90 + i, noise=noise) for i, p in enumerate(poses)]
        klt.set_initial(noisy[0])
        errors, sigmas = [], []
        for pose, frame in zip(poses, noisy, strict=True):
            views = klt.update(frame)
            errors.append(bearing_errors(views, pose, room(NAME, WIDTH)))
            sigmas.append(np.degrees(views.sigma))
        scatter = 1.4826 * np.median(np.concatenate(errors[6:]))
        assert 0.4 < np.mean(sigmas[6:]) / scatter < 2.5


def test_a_repeated_frame_gives_the_same_views(tracker, drive):
    _, images = drive
    klt = tracker()
    klt.set_initial(images[0])
    first = klt.update(images[1])
    assert klt.update(images[1]) is first
    klt.update(images[2])
    assert not same(klt.update(images[3]), first)


def test_the_same_frames_give_the_same_bits_through_a_blackout(drive):
    _, images = drive
    sequence = [*images[:4], *(dark(50 + i) for i in range(3)), *images[9:]]
    runs = []
    for _ in range(2):
        klt = shown_the_target(NAME, WIDTH)
        klt.set_initial(images[0])
        runs.append([klt.update(frame) for frame in sequence])
        klt.close()
    assert all(same(a, b) for a, b in zip(*runs, strict=True))


def test_a_blackout_of_a_second_is_survived_while_moving(tracker):
    """The robot turns by 25 deg and drives 0.4 m in the dark: tracking cannot bridge that."""
    there = Pose(-0.25, -0.75, START.phi + np.radians(25))
    poses = [*line(START, START, 3), *line(there, TARGET, 14)]
    klt = tracker()
    seen = list(frames(NAME, poses, WIDTH))
    klt.set_initial(seen[0])
    before = [klt.update(frame) for frame in seen[:3]]
    for number in range(10):
        views = klt.update(dark(100 + number))
        assert views.health is Health.LOST
        assert "blank" in views.reason
        assert len(views) == 0
    after = [klt.update(Frame(f.stamp, 200 + i, f.image)) for i, f in enumerate(seen[3:], start=1)]
    found = [number for number, views in enumerate(after) if views.health is Health.OK]
    assert found[0] <= klt.options.reacquisition_ticks
    assert found == list(range(found[0], len(after)))
    assert len(after[-1]) >= 0.9 * len(before[0])
    for number in found:
        error = bearing_errors(after[number], poses[3 + number], room(NAME, WIDTH))
        assert np.mean(error > 0.5) <= 0.05


def test_a_passing_obstacle_takes_no_tracks_along(tracker):
    poses = line(START, (-0.25, -0.75, START.phi / 2), 16)
    klt, scene = tracker(), room(NAME, WIDTH)
    counts = []
    for number, pose in enumerate(poses):
        x = -1.6 + 0.3 * number
        board = wall((x, 0.0), (x + 1.0, 0.05), 0.0, 2.2, 40)
        passing = [board] if 2 <= number < 11 else []
        frame = scene.frame(pose, 1 + number, noise=2.0, extra=passing)
        if number == 0:
            klt.set_initial(frame)
        views = klt.update(frame)
        assert views.health is Health.OK
        error = bearing_errors(views, pose, scene)
        assert np.mean(error > 0.5) <= 0.03
        counts.append(len(views))
    assert counts[-1] >= 0.95 * counts[0]


def test_an_obstacle_in_front_of_everything_is_loss_then_recovery(tracker):
    name, width = "perspective", 320
    scene, klt = room(name, width), tracker(name, width)
    poses = line(AHEAD, (-0.1, -0.6, AHEAD.phi / 2), 18)
    health = []
    for number, pose in enumerate(poses):
        board = wall((-1.5, -0.3), (1.5, -0.25), 0.0, 2.2, 41)
        frame = scene.frame(pose, 1 + number, noise=2.0, extra=[board] if 3 <= number < 7 else [])
        if number == 0:
            klt.set_initial(frame)
        views = klt.update(frame)
        health.append(views.health)
        if views.health is Health.OK:
            assert np.mean(bearing_errors(views, pose, scene) > 0.5) <= 0.03
    assert health[:3] == [Health.OK] * 3
    assert Health.LOST in health[3:7]
    assert health[-3:] == [Health.OK] * 3
    assert len(views) >= 100


@pytest.mark.parametrize("swing", [0.3])
def test_exposure_changes_do_not_matter(tracker, drive, swing):
    poses, _ = drive
    klt, scene = tracker(), room(NAME, WIDTH)
    for number, pose in enumerate(poses):
        gain = 1.0 + swing * (-1) ** number
        frame = scene.frame(pose, 1 + number, noise=2.0, gain=gain)
        if number == 0:
            klt.set_initial(frame)
        views = klt.update(frame)
        assert views.health is Health.OK
        error = bearing_errors(views, pose, scene)
        assert np.median(error) < 0.1
        assert np.mean(error > 0.5) <= 0.03


def test_turning_at_full_speed_is_followed(tracker):
    """50 deg/s and a dropped frame: 10 deg from one image to the next."""
    turns = [0, 0, 5, 10, 20, 30, 40, 35, 25, 15, 5, 0]
    poses = [START._replace(phi=START.phi + np.radians(t)) for t in turns]
    klt = tracker()
    for number, (pose, frame) in enumerate(zip(poses, frames(NAME, poses, WIDTH), strict=True)):
        if number == 0:
            klt.set_initial(frame)
        views = klt.update(frame)
        assert views.health is Health.OK
        assert np.mean(bearing_errors(views, pose, room(NAME, WIDTH)) > 0.5) <= 0.03
        assert len(views) >= 100


def test_a_new_initial_view_leaves_nothing_of_the_old_one(tracker, drive):
    _, images = drive
    used, fresh = tracker(), tracker()
    used.set_initial(images[0])
    for frame in [*images[:4], dark(60), dark(61), images[9], images[10]]:
        used.update(frame)
    used.set_initial(images[5])
    fresh.set_initial(images[5])
    for frame in images[5:9]:
        assert same(used.update(frame), fresh.update(frame))
    # The same picture again is news to a tracker that has been started anew.
    used.set_initial(images[8])
    assert same(used.update(images[8]), used.update(images[8]))


def test_closing_ends_the_thread(drive):
    _, images = drive
    before = threading.active_count()
    klt = shown_the_target(NAME, WIDTH)
    klt.set_initial(images[0])
    klt.update(Frame(0.0, 70, np.ascontiguousarray(np.rot90(images[0].image, 2))))
    klt.update(Frame(0.0, 71, np.ascontiguousarray(images[0].image[:, ::-1])))
    assert threading.active_count() > before
    klt.close()
    klt.close()
    assert threading.active_count() == before


def test_several_target_frames_are_averaged(drive):
    poses, images = drive
    scene = room(NAME, WIDTH)
    errors = []
    for count in (1, 8):
        klt = Klt(KltOptions(), context(scene.camera))
        klt.set_target([scene.frame(TARGET, 300 + i, noise=20.0) for i in range(count)])
        klt.set_initial(images[0])
        errors.append(np.median(bearing_errors(klt.update(images[1]), poses[1], scene)))
        klt.close()
    assert errors[1] < errors[0]


def test_targets_that_cannot_serve_are_refused_with_the_reason():
    scene = room(NAME, WIDTH)
    klt = Klt(KltOptions(), context(scene.camera))
    shape = (scene.camera.height, scene.camera.width)
    with pytest.raises(InputError, match="no target image"):
        klt.set_target([])
    with pytest.raises(InputError, match="is blank"):
        klt.set_target([dark(1)])
    with pytest.raises(InputError, match="is 640x480, but camera 'hypercatadioptric' takes"):
        klt.set_target([Frame(0.0, 1, np.zeros((480, 640), np.uint8))])
    with pytest.raises(InputError, match="use the perception 'features'"):
        klt.set_target([Frame(0.0, 1, features=Features(np.arange(2), np.zeros((2, 2))))])
    slope = np.tile(np.linspace(20, 220, shape[1]).astype(np.uint8), (shape[0], 1))
    with pytest.raises(InputError, match=r"has \d+ features, 20 are needed"):
        klt.set_target([Frame(0.0, 1, slope)])


def test_another_place_is_not_recognised(tracker):
    klt = tracker()
    camera = room(NAME, WIDTH).camera
    noise = np.random.default_rng(1).integers(0, 255, (camera.height // 5, camera.width // 5))
    elsewhere = np.kron(noise, np.ones((5, 5))).astype(np.uint8)
    with pytest.raises(InputError, match=r"not recognised from the start: \d+ features agree, 20"):
        klt.set_initial(Frame(0.0, 1, elsewhere))
    with pytest.raises(InputError, match="the initial image is blank"):
        klt.set_initial(dark(2))


def test_frames_without_a_usable_image_are_loss_not_failure(tracker, drive):
    _, images = drive
    klt = tracker()
    klt.set_initial(images[0])
    assert klt.update(Frame(1.0, 80)).health is Health.LOST
    wrong = klt.update(Frame(1.1, 81, np.zeros((10, 10), np.uint8)))
    assert wrong.health is Health.LOST
    assert "shape (10, 10)" in wrong.reason
    assert klt.update(images[1]).health is Health.OK


def test_the_signals_are_reported_as_declared(tracker, drive):
    _, images = drive
    klt = tracker()
    klt.set_initial(images[0])
    klt.update(images[1])
    assert set(klt.values()) == {signal.name for signal in klt.signals}
    assert klt.values()["features_tracked"] == 120.0
