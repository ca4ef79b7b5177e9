from __future__ import annotations

import numpy as np
from driving import START, TARGET, bearing_errors, context, frames, line, room, target_frame

from visctrl.contracts import Health
from visctrl.hal.types import Frame
from visctrl.perception.sift import Sift, SiftOptions

NAME, WIDTH = "hypercatadioptric", 400


def test_every_frame_is_matched_anew_to_the_same_landmarks():
    sift = Sift(SiftOptions(), context(room(NAME, WIDTH).camera))
    sift.set_target([target_frame(NAME, WIDTH)])
    poses = line(START, TARGET, 4)
    for number, (pose, frame) in enumerate(zip(poses, frames(NAME, poses, WIDTH), strict=True)):
        if number == 0:
            match = sift.set_initial(frame)
            assert len(match.target_pixels) == len(match.initial_pixels) == match.inliers
        views = sift.update(frame)
        error = bearing_errors(views, pose, room(NAME, WIDTH))
        assert views.health is Health.OK
        assert np.all(np.diff(views.ids) > 0)
        assert len(views) >= 60
        assert np.median(error) < 0.2
        assert np.mean(error > 1.0) <= 0.03
    assert sift.update(frame) is views


def test_an_unknown_place_is_loss():
    sift = Sift(SiftOptions(), context(room(NAME, WIDTH).camera))
    sift.set_target([target_frame(NAME, WIDTH)])
    start = next(frames(NAME, [START], WIDTH))
    sift.set_initial(start)
    noise = np.random.default_rng(1).integers(0, 255, (60, 80))
    elsewhere = np.kron(noise, np.ones((5, 5))).astype(np.uint8)
    views = sift.update(Frame(0.0, 9, elsewhere))
    assert views.health is Health.LOST
    assert views.reason
