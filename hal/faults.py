"""Faults that simulated devices show on demand, so that what happens then can be tested."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from visctrl.hal.errors import LinkError
from visctrl.hal.types import Features, Frame
from visctrl.robots.documents import StrictModel


def _ordered(interval: tuple[float, float]) -> tuple[float, float]:
    start, end = interval
    if not 0.0 <= start < end:
        raise ValueError("expected [start, end] in seconds with 0 <= start < end")
    return interval


def _several(value: Any) -> Any:
    """Take a single interval for a list of one, and nothing for an empty one."""
    if value is None:
        return []
    single = isinstance(value, list | tuple) and len(value) == 2
    return [value] if single and not any(isinstance(v, list | tuple) for v in value) else value


#: [start, end) in seconds on the backend's clock since it was opened.
Interval = Annotated[tuple[float, float], AfterValidator(_ordered)]
#: Any number of them; a single one may stand without the outer brackets.
Intervals = Annotated[tuple[Interval, ...], BeforeValidator(_several)]


class Faults(StrictModel):
    """When devices misbehave; by default they never do.

    Each fault is an interval [start, end] in seconds, or a list of them.

    A frozen camera repeats its last frame, stamp and sequence number included. A black one
    delivers new frames that show nothing. While the link is dead, every command fails. A
    dropped frame is the previous one, read again.
    """

    camera_frozen_s: Intervals = ()
    camera_black_s: Intervals = ()
    link_dead_s: Intervals = ()
    frame_drop_probability: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0


def active(intervals: tuple[tuple[float, float], ...], t: float) -> bool:
    """Return whether ``t`` (s) lies in any of the intervals."""
    return bool(intervals) and any(start <= t < end for start, end in intervals)


def check_link(faults: Faults, t: float) -> None:
    """Raise `LinkError` if the link to the base is dead at ``t`` (s)."""
    if active(faults.link_dead_s, t):
        raise LinkError(f"the base does not answer (simulated dead link at {t:.2f} s)")


def blackened(frame: Frame) -> Frame:
    """Return ``frame`` as a covered camera delivers it: zeros, and no feature."""
    image = None if frame.image is None else np.zeros_like(frame.image)
    features = None
    if frame.features is not None:
        features = Features(np.empty(0, dtype=np.int64), np.empty((0, 2)))
    return frame._replace(image=image, features=features)


class FaultyCapture:
    """Puts the camera's faults between the capture of a frame and its delivery.

    Parameters
    ----------
    faults : Faults
        What happens when.
    rng : numpy Generator
        Decides which frames are dropped; used only where the probability is not zero.
    """

    def __init__(self, faults: Faults, rng: np.random.Generator) -> None:
        self._faults = faults
        self._rng = rng
        self._last: Frame | None = None

    def deliver(self, t: float, capture: Callable[[], Frame]) -> Frame:
        """Return what the camera delivers at ``t`` (s); ``capture`` is called for new frames."""
        if self._last is not None and self._repeats(t):
            return self._last
        frame = capture()
        self._last = blackened(frame) if active(self._faults.camera_black_s, t) else frame
        return self._last

    def _repeats(self, t: float) -> bool:
        probability = self._faults.frame_drop_probability
        dropped = probability > 0.0 and self._rng.random() < probability
        return dropped or active(self._faults.camera_frozen_s, t)
