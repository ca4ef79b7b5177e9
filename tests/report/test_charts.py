"""Charts as numbers: what is drawn is where the values say."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from visctrl.contracts import Array, Views
from visctrl.hal.types import Pose
from visctrl.robots import load_robot
from visctrl.viewers.report.svg import (
    HEIGHT,
    MARGINS,
    WIDTH,
    Chart,
    Line,
    draw_chart,
    line_path,
    round_steps,
    value_range,
)
from visctrl.viewers.report.topview import DrivenPath, Outline, box_shape, disc_shape, draw_paths
from visctrl.viewers.track_history import TrackHistory

VALUE = st.floats(-1e6, 1e6)


def drawn(svg: str, kind: str) -> list[list[tuple[float, float]]]:
    """Return the points of every path of a class."""
    found = []
    for data in re.findall(rf'<path class="{kind}[^"]*" d="([^"]*)"', svg):
        pairs = re.findall(r"(-?[\d.]+) (-?[\d.]+)", data)
        found.append([(float(u), float(v)) for u, v in pairs])
    return found


def scales(svg: str) -> tuple[list[float], list[float]]:
    x, y = (re.search(rf'data-{axis}="([^"]*)"', svg) for axis in "xy")
    assert x is not None
    assert y is not None
    return [float(n) for n in x[1].split(",")], [float(n) for n in y[1].split(",")]


def back(pixel: float, scale: list[float]) -> float:
    low, high, first, last = scale
    return low + (pixel - first) / (last - first) * (high - low)


@given(st.lists(VALUE, min_size=2, max_size=40))
def test_a_drawn_line_gives_its_values_back(values: list[float]) -> None:
    t = np.linspace(0.0, 5.0, len(values))
    svg = draw_chart(Chart("name", "m", t, [Line("a", np.array(values), 0)]))
    x, y = scales(svg)
    (points,) = drawn(svg, "line")
    resolution = 0.06 * (y[1] - y[0]) / abs(y[3] - y[2])
    # Far outliers are cut off: they are drawn outside the plot.
    for (u, v), when, value in zip(points, t, values, strict=True):
        assert back(u, x) == pytest.approx(when, abs=0.01)
        if y[0] <= value <= y[1]:
            assert back(v, y) == pytest.approx(value, abs=resolution)
        else:
            assert not MARGINS[1] < v < HEIGHT - MARGINS[3]


def test_a_band_is_two_standard_deviations_on_either_side() -> None:
    t, values, sd = np.arange(3.0), np.array([0.0, 1.0, 0.5]), np.array([0.1, 0.2, 0.05])
    svg = draw_chart(Chart("name", "m", t, [Line("a", values, 0, sd)]))
    _, y = scales(svg)
    (outline,) = drawn(svg, "band")
    heights = [back(v, y) for _, v in outline]
    expected = [*(values + 2.0 * sd), *(values - 2.0 * sd)[::-1]]
    assert heights == pytest.approx(expected, abs=0.01)


def test_unknown_values_leave_gaps() -> None:
    nan = math.nan
    path = line_path(np.arange(5.0), np.array([1.0, nan, 2.0, 3.0, nan]))
    assert path == "M0.0 1.0h0.1M2.0 2.0L3.0 3.0"
    assert line_path(np.arange(2.0), np.array([nan, math.inf])) == ""


def test_a_long_line_keeps_its_extremes() -> None:
    values = np.zeros(100_000)
    values[12_345], values[77_777] = 5.0, -7.0
    path = line_path(np.arange(100_000.0), values)
    heights = [float(v) for _, v in re.findall(r"(-?[\d.]+) (-?[\d.]+)", path)]
    assert (max(heights), min(heights)) == (5.0, -7.0)
    assert len(heights) < 1000


def test_a_stack_is_as_high_as_its_sum() -> None:
    t = np.arange(4.0)
    lines = [Line(name, np.full(4, k + 1.0), k) for k, name in enumerate("abc")]
    svg = draw_chart(Chart("name", "ms", t, lines, stacked=True))
    _, y = scales(svg)
    tops = [back(max(v for _, v in area[:4]), y) for area in drawn(svg, "area")]
    assert tops == pytest.approx([1.0, 3.0, 6.0], abs=0.05)


@given(VALUE, st.floats(1e-6, 1e6), st.integers(2, 9))
def test_axis_numbers_are_few_and_inside(low: float, size: float, most: int) -> None:
    size = max(size, 1e-6 * abs(low))
    steps = round_steps(low, low + size, most)
    assert len(steps) <= most + 1
    assert all(low - 1e-6 * size <= step <= low + size * (1.0 + 1e-6) for step in steps)


def test_an_epipole_at_infinity_does_not_flatten_the_rest() -> None:
    values = np.concatenate([np.linspace(-0.2, 0.3, 200), [1e9]])
    low, high = value_range([Line("e", values, 0)], from_zero=False)
    assert -0.5 < low < -0.15
    assert 0.25 < high < 1.0


@pytest.mark.parametrize("values", [[], [math.nan], [2.0], [0.0, 0.0]])
def test_a_chart_of_next_to_nothing_can_be_drawn(values: list[float]) -> None:
    t = np.arange(float(len(values)))
    assert "nan" not in draw_chart(Chart("name", "", t, [Line("a", np.array(values), 0)]))


def test_the_outline_surrounds_the_axle() -> None:
    """The camera of the mount ``front`` is ahead of it, the robot's rear longer than its front."""
    robot = load_robot("p3dx")
    corners = Outline.of(robot, robot.mount("front")).at(Pose(1.0, 2.0, math.pi / 2))
    # Turned left by 90 degrees, forward is −x.
    assert corners[:, 0].min() == pytest.approx(1.0 - (0.210 - 0.10))
    assert corners[:, 0].max() == pytest.approx(1.0 + 0.301 + 0.10)
    assert corners[:, 1].min() == pytest.approx(2.0 - 0.425 / 2)


def test_outlines_follow_the_path_and_its_turns() -> None:
    robot = load_robot("p3dx")
    outline = Outline.of(robot, robot.mount("centre"))
    t = np.linspace(0.0, 10.0, 101)
    still = np.zeros(101)
    stands = DrivenPath("a", t, still, still, still, 0)
    turns = DrivenPath("a", t, still, still, np.linspace(0.0, math.pi, 101), 0)
    drives = DrivenPath("a", t, still, np.linspace(-3.0, 0.0, 101), still, 0)
    counts = [
        draw_paths([path], outline, None, caption="c").count('class="outline"')
        for path in (stands, turns, drives)
    ]
    assert counts[0] <= 2
    assert counts[1] == 7, "every 30 degrees"
    assert counts[2] == 11, "every 0.3 m"


def test_a_path_keeps_its_shape() -> None:
    """Metres are as long to the right as ahead."""
    x, y = np.array([0.0, 3.0, 3.0]), np.array([0.0, 0.0, 1.0])
    path = DrivenPath("a", np.arange(3.0), x, y, np.zeros(3), 0)
    (points,) = drawn(draw_paths([path], None, None, caption="c"), "line")
    (a, b, c) = (np.array(point) for point in points)
    assert (b - a)[0] == pytest.approx(3.0 * (b - c)[1], abs=0.3)
    assert (b - a)[1] == (c - b)[0] == 0.0
    assert all(0.0 <= u <= WIDTH for u, _ in points)


def seen(ids: list[int], at: float) -> Views:
    pixels: Array = np.full((len(ids), 2), at)
    rays = np.zeros((len(ids), 3))
    return Views(np.array(ids, dtype=np.int64), rays, rays, rays, pixels, 0.0, at)


def test_tracks_are_whole_and_memory_is_bounded() -> None:
    history = TrackHistory()
    ticks = 5000
    for k in range(ticks):
        history.add(seen([1, 2] if k < 2500 else [2, 3], float(k)))
    last = seen([2, 3, 4], float(ticks))
    first, second, third = history.of(last)
    assert first[0, 0] == 0.0
    assert second[0, 0] == pytest.approx(2500.0, abs=100.0)
    assert third.tolist() == [[ticks, ticks]]
    for track in (first, second):
        assert len(track) < 300
        assert track[-1, 0] == ticks
        assert (np.diff(track[:, 0]) > 0).all()
    history.clear()
    assert [len(track) for track in history.of(last)] == [1, 1, 1]


def test_obstacles_stand_where_they_are_and_fit_into_the_picture() -> None:
    box = box_shape(1.0, 2.0, (0.4, 0.2), math.pi / 2)
    assert np.ptp(box, axis=0) == pytest.approx([0.2, 0.4])
    assert box.mean(axis=0) == pytest.approx([1.0, 2.0])
    disc = disc_shape(-5.0, 0.0, 0.5)
    assert np.hypot(*(disc - [-5.0, 0.0]).T) == pytest.approx(0.5)
    x = np.array([0.0, 1.0])
    path = DrivenPath("a", x, x, x, x, 0)
    svg = draw_paths([path], None, None, [box, disc], caption="c")
    shapes = drawn(svg, "obstacle")
    assert len(shapes) == 2
    assert min(u for shape in shapes for u, _ in shape) > 0.0
