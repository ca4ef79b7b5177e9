"""Faults on demand, on frames that are only numbered."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from visctrl.hal.errors import LinkError
from visctrl.hal.faults import Faults, FaultyCapture, active, blackened, check_link
from visctrl.hal.types import Features, Frame


class Source:
    """Counts the frames that are really captured."""

    def __init__(self, faults: Faults, seed: int = 0) -> None:
        self.captured = 0
        self._capture = FaultyCapture(faults, np.random.default_rng(seed))

    def read(self, t: float) -> Frame:
        def expose() -> Frame:
            self.captured += 1
            features = Features(np.array([3]), np.array([[1.0, 2.0]]))
            return Frame(t, self.captured, np.full((2, 2), 9, np.uint8), features)

        return self._capture.deliver(t, expose)


def test_intervals_hold_their_start_and_not_their_end() -> None:
    assert not active((), 1.0)
    both = ((1.0, 2.0), (3.0, 4.0))
    assert [active(both, t) for t in (0.99, 1.0, 1.99, 2.0)] == [False, True, True, False]
    assert [active(both, t) for t in (2.99, 3.0, 3.99, 4.0)] == [False, True, True, False]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (None, ()),
        ([], ()),
        ([1, 2], ((1.0, 2.0),)),
        ([[1, 2], [3, 4]], ((1.0, 2.0), (3.0, 4.0))),
    ],
)
def test_there_may_be_none_one_or_several(
    given: object, expected: tuple[tuple[float, float], ...]
) -> None:
    faults = Faults.model_validate({"link_dead_s": given})
    assert faults.link_dead_s == expected
    assert Faults.model_validate(faults.model_dump(mode="json")) == faults


@pytest.mark.parametrize("interval", [(2.0, 1.0), (1.0, 1.0), (-1.0, 1.0)])
def test_intervals_are_in_order(interval: tuple[float, float]) -> None:
    with pytest.raises(ValidationError, match="start < end"):
        Faults(camera_black_s=(interval,))


def test_without_faults_every_frame_is_new() -> None:
    source = Source(Faults())
    assert [source.read(0.1 * k).sequence for k in range(5)] == [1, 2, 3, 4, 5]


def test_a_frozen_camera_repeats_stamp_and_number() -> None:
    source = Source(Faults(camera_frozen_s=((1.0, 2.0),)))
    before, frozen, still, after = (source.read(t) for t in (0.9, 1.0, 1.9, 2.0))
    assert frozen is before
    assert still is before
    assert after.sequence == before.sequence + 1


def test_a_camera_frozen_from_the_start_delivers_one_frame() -> None:
    source = Source(Faults(camera_frozen_s=((0.0, 2.0),)))
    assert source.read(0.0) is source.read(1.0)


def test_a_black_camera_goes_on_counting_and_shows_nothing() -> None:
    source = Source(Faults(camera_black_s=((1.0, 2.0),)))
    seen, black, again = (source.read(t) for t in (0.9, 1.5, 2.5))
    assert [frame.sequence for frame in (seen, black, again)] == [1, 2, 3]
    assert black.stamp == 1.5
    assert black.image is not None
    assert not black.image.any()
    assert black.image.shape == (2, 2)
    assert black.features is not None
    assert black.features.pixels.shape == (0, 2)
    assert again.image is not None
    assert again.image.all()


def test_black_keeps_what_a_frame_does_not_carry() -> None:
    black = blackened(Frame(1.0, 2))
    assert black.image is None
    assert black.features is None


def test_frames_are_dropped_as_often_as_asked_and_by_the_seed() -> None:
    count = 4000
    sources = [Source(Faults(frame_drop_probability=0.25), seed) for seed in (1, 1, 2)]
    numbers = [[source.read(0.1 * k).sequence for k in range(count)] for source in sources]
    assert numbers[0] == numbers[1] != numbers[2]
    # Four standard deviations of a binomial count.
    assert abs(sources[0].captured / count - 0.75) < 4 * (0.25 * 0.75 / count) ** 0.5


def test_a_dead_link_raises_only_while_it_is_dead() -> None:
    faults = Faults(link_dead_s=((1.0, 2.0),))
    check_link(faults, 0.9)
    with pytest.raises(LinkError, match="does not answer"):
        check_link(faults, 1.5)
    check_link(faults, 2.0)
