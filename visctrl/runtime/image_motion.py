"""A test of whether the camera shows the present: motion in the image against odometry.

A picture that stands still while the robot moves is of the past, however fresh its stamp and
whatever noise lies on it. For each band of image rows (a torn picture is old in some rows only)
the features of now are compared with those of a moment ago:

* The robot turns: every ray turns by as much the other way. The band is old if most of its rays
  have stayed where they were; of a robot that drives an arc, by no more than the noise.
* It drives straight: how far rays move depends on how far away things are, so the test learns it
  from the run itself, and a scene too far away for it gives no verdict. The band is old if its
  rays move by a small share of what they did a window ago.

A slow robot is judged over a longer time, one that stands not at all.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Views
from visctrl.hal.types import Odometry
from visctrl.robots.unicycle import wrapped

Array = NDArray[np.float64]

#: Longest time that is looked back (s), at most so many frames.
_WINDOW_S, _RECENT_S, _FRAMES = 1.5, 0.4, 20
#: The image may lag behind its stamp by as much as this (s): motion counts that it must show
#: whatever its lag.
_LAGS_S = (0.0, 0.1, 0.2)
#: Least turn that is judged (rad), and in standard deviations of a bearing; least way (m).
_TURN, _SIGMAS, _WAY_M = math.radians(1.5), 8.0, 0.04
#: A ray that has moved by less than this share of a turn has stayed.
_STAYED = 0.3
#: A band's median ray on a straight way: from so many standard deviations on its motion is
#: judged (that of a picture that stands still is 1.7, by noise); under this share it has stayed,
#: if it is no more than the noise can be.
_WAY_SIGMAS, _WAY_STAYED, _NOISE_SIGMAS = 8.0, 0.3, 2.5
#: Motion that is learnt from stands out of the noise by so much (standard deviations).
_LEARN_SIGMAS = 5.0
#: So large a share of a band's rays must have stayed when the robot turned.
_MOST = 0.6
#: Bands of image rows, and how few features tell something about one.
_BANDS, _LEAST = 3, 8
#: So many frames in a row must agree.
_IN_A_ROW = 2
#: Weight of a new measurement of how far rays move per metre.
_LEARNING = 0.2


class _Seen(NamedTuple):
    """A frame: its features, and heading (rad, unwrapped) and way (m) for every lag."""

    stamp: float
    ids: NDArray[np.int64]
    rays: Array
    headings: tuple[float, ...]
    ways: tuple[float, ...]


class ImageMotion:
    """Watches the views of a stage; one object a stage.

    Parameters
    ----------
    rows : int
        Height of the image.
    """

    def __init__(self, rows: int) -> None:
        self._rows = rows
        self._moved: deque[tuple[float, float, float]] = deque(maxlen=4 * _FRAMES)
        self._seen: deque[_Seen] = deque(maxlen=_FRAMES)
        self._rates = [_Rate() for _ in range(_BANDS)]
        self._suspicious = 0

    def judge(self, views: Views, odometry: Odometry) -> str:
        """Return why these views cannot be of the present, empty where nothing speaks against it.

        odometry : the base's newest.
        """
        self._move(odometry)
        if len(views) < _LEAST or (self._seen and views.stamp <= self._seen[-1].stamp):
            return ""
        headings, ways = self._at(views.stamp)
        now = _Seen(views.stamp, views.ids, views.current, headings, ways)
        bands = np.minimum(views.pixels[:, 1] * (_BANDS / self._rows), _BANDS - 1).astype(np.int64)
        verdict = self._turned(now, views.sigma, bands) or self._driven(now, views.sigma, bands)
        self._seen.append(now)
        self._suspicious = self._suspicious + 1 if verdict else 0
        return verdict if self._suspicious >= _IN_A_ROW else ""

    def _move(self, odometry: Odometry) -> None:
        """Note heading and way at the time of an odometry report."""
        stamp, pose = odometry.stamp, odometry.pose
        if not self._moved:
            self._place = pose
            self._moved.append((stamp, pose.phi, 0.0))
            return
        before, heading, way = self._moved[-1]
        if stamp <= before:
            return
        heading += wrapped(pose.phi - heading)
        dx, dy = pose.x - self._place.x, pose.y - self._place.y
        way += dy * math.cos(pose.phi) - dx * math.sin(pose.phi)
        self._place = pose
        self._moved.append((stamp, heading, way))

    def _at(self, stamp: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return heading and way at a time, and at the earlier ones that its image may be of."""
        stamps, headings, ways = np.array(self._moved).T
        times = [stamp - lag for lag in _LAGS_S]
        return (
            tuple(np.interp(times, stamps, headings).tolist()),
            tuple(np.interp(times, stamps, ways).tolist()),
        )

    def _turned(self, now: _Seen, sigma: float, bands: NDArray[np.int64]) -> str:
        """Compare with the newest frame since which the robot has turned enough."""
        least = max(_TURN, _SIGMAS * sigma)
        for then in reversed(self._seen):
            if now.stamp - then.stamp > _WINDOW_S:
                break
            turns = [a - b for a, b in zip(now.headings, then.headings, strict=True)]
            if min(turns) < least and max(turns) > -least:
                continue
            turn = min(turns, key=abs)
            ways = [abs(a - b) for a, b in zip(now.ways, then.ways, strict=True)]
            before, after, rows = _common(then, now, bands)
            due = np.linalg.norm(_turned_by(before, turn) - before, axis=1)
            moved = np.linalg.norm(after - before, axis=1)
            told = due > 0.5 * abs(turn)  # rays that point up or down hardly move
            for band in range(_BANDS):
                here = told & (rows == band)
                if here.sum() < _LEAST or (moved < _STAYED * due)[here].mean() <= _MOST:
                    continue
                # On an arc, things at one side can hold their bearing: what the turn does to them
                # the way undoes. They move by more than the noise all the same.
                if max(ways) < _WAY_M or _middle(moved[here]) < _NOISE_SIGMAS * sigma:
                    degrees = math.degrees(abs(turn))
                    return (
                        f"the camera shows the past: the robot has turned by {degrees:.1f} deg in "
                        f"{now.stamp - then.stamp:.1f} s, and the picture, or part of it, has not"
                    )
            return ""
        return ""

    def _driven(self, now: _Seen, sigma: float, bands: NDArray[np.int64]) -> str:
        """Compare, band by band, with the newest frame since which the rays must have moved."""
        straight = [(then, way) for then in reversed(self._seen) if (way := _straight(then, now))]
        # What was known before the window; what is known since counts where things get far away.
        rates = [
            min(rate.at(now.stamp - _WINDOW_S), rate.at(now.stamp - _RECENT_S))
            for rate in self._rates
        ]
        left = {band for band in range(_BANDS) if rates[band] > 0.0}
        for then, way in straight:
            due = {band for band in left if rates[band] * way > _WAY_SIGMAS * sigma}
            if not due:
                continue
            moved = _moved(then, now, bands)
            for band in due:
                here = moved[band]
                most = min(_WAY_STAYED * rates[band] * way, _NOISE_SIGMAS * sigma)
                if len(here) >= _LEAST and _middle(here) < most:
                    return (
                        f"the camera shows the past: the robot has driven {way:.2f} m in "
                        f"{now.stamp - then.stamp:.1f} s, and the picture, or part of it, has not "
                        "moved as it did before"
                    )
            left -= due
        if straight:
            then, way = straight[-1]
            for rate, here in zip(self._rates, _moved(then, now, bands), strict=True):
                if len(here) >= _LEAST:
                    middle = _middle(here)
                    # What does not stand out of the noise says that things are far away.
                    rate.learn(now.stamp, middle / way if middle > _LEARN_SIGMAS * sigma else 0.0)
        return ""


class _Rate:
    """How far a band's rays move per metre (rad/m), as it was known some time ago."""

    def __init__(self) -> None:
        self._known: deque[tuple[float, float]] = deque(maxlen=2 * _FRAMES)

    def learn(self, stamp: float, rate: float) -> None:
        """Take a measurement into account."""
        before = self._known[-1][1] if self._known else rate
        self._known.append((stamp, before + _LEARNING * (rate - before)))

    def at(self, stamp: float) -> float:
        """Return what was known at a time (s); 0 for nothing."""
        return next((rate for when, rate in reversed(self._known) if when <= stamp), 0.0)


def _straight(then: _Seen, now: _Seen) -> float:
    """Return how far the robot has driven straight since (m), at least; 0 where it has not."""
    if now.stamp - then.stamp > _WINDOW_S:
        return 0.0
    ways = [a - b for a, b in zip(now.ways, then.ways, strict=True)]
    turns = [a - b for a, b in zip(now.headings, then.headings, strict=True)]
    if max(map(abs, turns)) > _TURN or (min(ways) < _WAY_M and max(ways) > -_WAY_M):
        return 0.0
    return min(map(abs, ways))


def _moved(then: _Seen, now: _Seen, bands: NDArray[np.int64]) -> list[Array]:
    """Return by how much the rays of each band have moved against each other (rad).

    The turn that they share is taken off as the image itself shows it: nobody drives so straight
    that it would not outweigh what far things show of the way.
    """
    before, after, rows = _common(then, now, bands)
    bearings = np.arctan2(after[:, 0], after[:, 1]) - np.arctan2(before[:, 0], before[:, 1])
    shifts = np.remainder(bearings + math.pi, math.tau) - math.pi
    moved: list[Array] = []
    for band in range(_BANDS):
        here = rows == band
        turn = _middle(shifts[here]) if here.any() else 0.0
        moved.append(np.linalg.norm(after[here] - _turned_by(before[here], turn), axis=1))
    return moved


def _common(
    then: _Seen, now: _Seen, bands: NDArray[np.int64]
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return the rays (N, 3) of the features in both frames, then and now, and their bands."""
    if np.array_equal(then.ids, now.ids):
        return then.rays, now.rays, bands
    _, a, b = np.intersect1d(then.ids, now.ids, assume_unique=True, return_indices=True)
    return then.rays[a], now.rays[b], bands[b]


def _middle(values: Array) -> float:
    """Return the (upper) median; `np.median` takes ten times as long for so few."""
    half = len(values) // 2
    return float(np.partition(values, half)[half])


def _turned_by(rays: Array, turn: float) -> Array:
    """Return rays (right, forward, up) as a robot sees them that has turned (rad)."""
    s, c = math.sin(turn), math.cos(turn)
    right, forward = rays[:, 0], rays[:, 1]
    return np.stack([c * right + s * forward, c * forward - s * right, rays[:, 2]], axis=1)
