"""Perception that looks at nothing, for runs in which only the devices matter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from hal.types import Frame
from robots.documents import Document
from visctrl.plugins import Match, Perception, Views


class BlindOptions(Document):
    pass


class Blind(Perception[BlindOptions]):
    """Takes any image and reports the same twenty features."""

    Options: ClassVar[type[BlindOptions]] = BlindOptions

    def set_target(self, frames: Sequence[Frame]) -> None:
        assert all(frame.image is not None for frame in frames)

    def set_initial(self, frame: Frame) -> Match:
        assert frame.image is not None
        return Match(20, 20, np.zeros((20, 2)), np.zeros((20, 2)))

    def update(self, frame: Frame) -> Views:
        rays = np.tile([0.0, 1.0, 0.0], (20, 1))
        return Views(np.arange(20), rays, rays, rays, np.zeros((20, 2)), 0.001, frame.stamp)
