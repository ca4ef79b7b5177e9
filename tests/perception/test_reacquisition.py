from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from driving import START, room

from visctrl.perception.landmarks import Recognised
from visctrl.perception.matching import describe
from visctrl.perception.pictures import draw
from visctrl.perception.reacquisition import Reacquisition
from visctrl.perception.three_view import Resection
from visctrl.perception.unwrap import canvas_for

NAME, WIDTH = "hypercatadioptric", 400


@pytest.fixture(scope="module")
def canvas():
    return canvas_for(room(NAME, WIDTH).camera)


@pytest.fixture(scope="module")
def turning(canvas):
    """Return pictures of a robot that turns by 2 deg from one to the next."""
    poses = [START._replace(phi=START.phi + np.radians(2.0 * i)) for i in range(5)]
    return [draw(room(NAME, WIDTH).frame(p, 1, noise=2.0).image, canvas) for p in poses]


def finder(canvas, *, wait=None):
    """Return a search that "recognises" every keypoint, when it is let."""

    def search(picture):
        if wait is not None:
            wait.wait(10)
        points = describe(picture.image, canvas, 60, 15).points
        fit = Resection(np.zeros(3), np.ones(len(points), dtype=bool), 0.0)
        return Recognised(np.arange(len(points)), points, fit)

    return search


def test_in_lockstep_the_result_comes_at_its_tick_and_is_up_to_date(canvas, turning):
    slow = threading.Event()
    search = Reacquisition(finder(canvas, wait=slow), canvas, 4, lockstep=True)
    search.start(turning[0])
    assert [search.take(p) for p in turning[1:4]] == [None] * 3
    threading.Timer(0.05, slow.set).start()
    found = search.take(turning[4])
    search.close()
    assert found is not None
    before = describe(turning[0].image, canvas, 60, 15).points[found.which]
    expected = canvas.canonical(before + np.array([canvas.scale * np.radians(8.0), 0.0]))
    error = np.linalg.norm(found.points - expected, axis=1)
    assert len(found.which) > 50
    assert np.median(error) < 0.15
    assert np.mean(error < 0.7) > 0.9


def test_on_a_wall_clock_the_result_comes_when_it_is_ready(canvas, turning):
    gate = threading.Event()
    search = Reacquisition(finder(canvas, wait=gate), canvas, 1, lockstep=False)
    search.start(turning[0])
    assert search.take(turning[1]) is None
    assert search.take(turning[2]) is None
    gate.set()
    found, deadline = None, time.monotonic() + 10
    while found is None and time.monotonic() < deadline:
        found = search.take(turning[2])
        time.sleep(0.01)
    search.close()
    assert found is not None


def test_one_search_at_a_time_and_none_unasked(canvas, turning):
    calls = []

    def search_for(picture):
        calls.append(picture)

    search = Reacquisition(search_for, canvas, 2, lockstep=True)
    assert search.take(turning[0]) is None
    search.start(turning[0])
    search.start(turning[1])
    assert search.take(turning[1]) is None
    assert search.take(turning[2]) is None
    assert len(calls) == 1
    search.close()


def test_closing_ends_the_thread_and_may_be_repeated(canvas, turning):
    before = threading.active_count()
    search = Reacquisition(finder(canvas), canvas, 2, lockstep=True)
    search.close()
    search.start(turning[0])
    assert threading.active_count() == before + 1
    search.close()
    search.close()
    assert threading.active_count() == before


def test_what_goes_wrong_in_the_search_is_not_hidden(canvas, turning):
    def broken(picture):
        raise ZeroDivisionError

    search = Reacquisition(broken, canvas, 1, lockstep=True)
    search.start(turning[0])
    with pytest.raises(ZeroDivisionError):
        search.take(turning[1])
    search.close()
