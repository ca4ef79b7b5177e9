"""What a folder of ``visctrl/schemes`` says of itself, without importing what it names."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Scheme:
    """A way of driving to the target: a preset of plugins by name.

    perception : for cameras that deliver images.
    identified : for backends that deliver identified features (the mock).
    mount : where the camera sits if the scenario does not say.
    approach : whether the robot first turns to the target when it does not head there.
    same_height : whether the camera must be as high as it was at the target view. What uses
        azimuths alone does not care; planar epipoles do.
    """

    title: str
    estimator: str
    controller: str
    perception: str = "klt"
    identified: str = "features"
    mount: str = "centre"
    approach: bool = True
    same_height: bool = False
